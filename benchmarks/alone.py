"""`python -m benchmarks.alone MODULE [DEVICE]`: one benchmark, in this process, which ends with it.

The last line on stdout is its result as JSON.
"""

import importlib
import json
import sys

from benchmarks import common


def main(module: str, device: str = "") -> None:
    """Prints the JSON."""
    if device:
        common.use(device)
    result = importlib.import_module(f"benchmarks.{module}").run()
    print(json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:])
