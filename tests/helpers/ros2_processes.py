"""Second processes on a DDS domain of this machine."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

HELPERS = Path(__file__).parent
LOOPBACK = """<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo"
multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>
<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
"""CYCLONEDDS_URI without multicast, which not every machine has."""


def begin_process(module: str, *words: object) -> subprocess.Popen[bytes]:
    """Start a module of tests/helpers; closing its standard input ends it."""
    path = os.pathsep.join([str(HELPERS), *filter(None, sys.path)])
    command = [sys.executable, HELPERS / f"{module}.py", *words]
    env = {**os.environ, "PYTHONPATH": path, "CYCLONEDDS_URI": LOOPBACK}
    return subprocess.Popen(list(map(str, command)), env=env, stdin=subprocess.PIPE)
