"""What moves an object: time, error, and where its limits are."""
