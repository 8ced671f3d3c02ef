"""Level of detection: how large a displacement must be before it can be distinguished from noise."""
