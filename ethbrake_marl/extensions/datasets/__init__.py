"""Episodes as datasets: Parquet and Minari."""
