"""Files: strict reading, durable writing. Nothing else knows a format."""
