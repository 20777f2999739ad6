"""The configuration: schema, YAML loader, sample printer and machine descriptions."""
