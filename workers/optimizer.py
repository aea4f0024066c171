"""The optimizer worker: ``python -P -m velod.workers.optimizer --connect tcp/127.0.0.1:17447``."""

import sys

from velod.runtime.worker import main

if __name__ == "__main__":
    sys.exit(main("optimizer"))
