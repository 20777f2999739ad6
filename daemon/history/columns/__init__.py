"""Column chunks: an hour of records, packed and unpacked without loss."""
