"""The flow worker: ``python -P -m velod.workers.flow --connect tcp/127.0.0.1:17447 --worker flow-0``."""

import sys

from velod.runtime.worker import main

if __name__ == "__main__":
    sys.exit(main("flow"))
