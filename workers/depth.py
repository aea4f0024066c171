"""The depth worker: ``python -P -m velod.workers.depth --connect tcp/127.0.0.1:17447 --worker depth-0``."""

import sys

from velod.runtime.worker import main

if __name__ == "__main__":
    sys.exit(main("depth"))
