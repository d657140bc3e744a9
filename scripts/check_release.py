#!/usr/bin/env python
"""Install each built distribution into a bare environment and run the demo with it.

python -m build && python scripts/check_release.py dist
"""

import argparse
import subprocess
import sys
import tempfile
import venv
from pathlib import Path


def main() -> int:
    """Check every wheel and sdist in a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    found = sorted(p for p in parser.parse_args().folder.iterdir() if p.suffix == ".whl" or p.name.endswith(".tar.gz"))
    if {p.suffix for p in found} != {".whl", ".gz"}:
        print("a wheel and an sdist are expected; try: python -m build")
        return 1
    for distribution in found:
        with tempfile.TemporaryDirectory() as folder:
            venv.create(folder, with_pip=True)
            python = str(Path(folder, "bin", "python"))
            subprocess.run([python, "-m", "pip", "install", "--quiet", str(distribution.resolve())], check=True)
            subprocess.run([python, "-m", "slamcli", "run", "demo", "-r", "run"], check=True, cwd=folder)
            print(f"{distribution.name}: installed, demo run")
    return 0


if __name__ == "__main__":
    sys.exit(main())
