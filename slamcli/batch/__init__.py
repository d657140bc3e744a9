"""Many recordings, worked off by a Dask cluster: each a chain of small tasks whose results are those of `slamcli run`, byte for byte."""
