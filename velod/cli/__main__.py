import sys

from velod.cli import main

sys.exit(main())
