"""The only list of knobs: schema, YAML loader, sample printer and machine descriptions."""
