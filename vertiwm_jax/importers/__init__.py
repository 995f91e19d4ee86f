"""Makes recorded drives of logs in other formats; one file for each format."""
