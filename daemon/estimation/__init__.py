"""From line cycles to the estimate: cleansing, and the thermal model in use, of whatever family."""
