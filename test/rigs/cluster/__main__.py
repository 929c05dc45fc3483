# SPDX-License-Identifier: Apache-2.0
"""
Run a cluster until Ctrl-C, to try things by hand, or so that runs of the tests share it.

    .venv/bin/python -m rigs.cluster "$(tools/kubernetes.sh)"
"""

from __future__ import annotations

import contextlib
from pathlib import Path
import signal
import sys

from rigs.cluster import cluster


def main() -> None:
    """Run it, and say how to use it."""
    if len(sys.argv) != 2:
        sys.exit('say where Kubernetes is: "$(tools/kubernetes.sh)" builds it and tells')
    binaries = Path(sys.argv[1])
    with cluster(binaries.parent, binaries) as running:
        print(f'export KUBECONFIG={running.kubeconfig} FOGROS2_CLUSTER={running.folder}',
              flush=True)
        signal.pause()


if __name__ == '__main__':
    # both unwind
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with contextlib.suppress(KeyboardInterrupt):
        main()
