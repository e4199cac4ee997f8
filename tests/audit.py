"""Known holes in the pinned packages, by pip-audit; one line where no advisories can be had.

Advisories come from the package index. A mirror may not have them, and a machine no network: then
nothing was checked, which is said, and is no failure.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

CONSTRAINTS = Path(__file__).parents[1] / "constraints.txt"
SECONDS = 180


def main() -> int:
    """1 if a package has a known hole."""
    command = [sys.executable, "-m", "pip_audit", "--requirement", str(CONSTRAINTS), "--no-deps"]
    command += ["--disable-pip", "--progress-spinner", "off", "--format", "json"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
        packages = json.loads(done.stdout)["dependencies"]
    except (subprocess.TimeoutExpired, ValueError, KeyError):
        print("pip-audit: no advisories can be had here; skipped")
        return 0
    checked = [package for package in packages if "vulns" in package]
    if not checked:
        print("pip-audit: the package index here has no advisories; skipped")
        return 0
    found = [(p["name"], p["version"], hole) for p in checked for hole in p["vulns"]]
    for name, version, hole in found:
        print(f"{name} {version}: {hole['id']}, mended in {', '.join(hole['fix_versions']) or '-'}")
    print(f"pip-audit: {len(checked)} of {len(packages)} packages checked, {len(found)} holes")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
