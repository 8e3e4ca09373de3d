"""What is claimed, measured on recordings that nobody simulated: `make validate` runs every section and writes docs/validation.md."""
