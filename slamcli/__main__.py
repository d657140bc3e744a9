"""`python -m slamcli`."""

from slamcli.cli.main import cli

if __name__ == "__main__":
    cli(prog_name="slamcli")
