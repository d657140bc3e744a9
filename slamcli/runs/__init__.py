"""Runs on a disk: `pipeline` makes what `staleness` calls for, `run_directory` keeps it. The rest reads whole runs, or clears them away."""
