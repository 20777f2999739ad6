"""The figures of the source's chapter on thermal errors, from the recordings of a campaign."""
