"""Run the first block of README.md as a newcomer does: in a fresh clone, with nothing installed.

``first_block.py FOLDER`` leaves the clone and its environment in the folder.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(*(sys.argv[1:] or [folder]), "turbrestore")
        subprocess.run(["git", "clone", "--quiet", "--depth", "1", ROOT.as_uri(), str(clone)], check=True)
        block = re.search(r"(?ms)^```\w*\n(.*?)^```$", (clone / "README.md").read_text("utf-8"))[1]
        # An environment that is active here is not the newcomer's.
        environment = {name: value for name, value in os.environ.items() if name not in ("VIRTUAL_ENV", "PYTHONPATH")}
        subprocess.run(["bash", "-euo", "pipefail"], input=block.encode(), cwd=clone, env=environment, check=True)
        sizes = {name: (clone / name).stat().st_size for name in ("sharp.png", "sharp.html")}
        assert min(sizes.values()) > 10_000, sizes
        print("\n".join(f"{name}: {size} bytes" for name, size in sizes.items()))


if __name__ == "__main__":
    main()
