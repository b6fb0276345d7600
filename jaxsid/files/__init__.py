"""Reading and writing: CSV, NPZ, MAT and UFF 58 records, the TOML model, results as JSON and CSV."""
