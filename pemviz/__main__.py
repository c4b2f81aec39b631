"""``python -m pemviz`` is the command line."""

import sys

from pemviz.cli import main

sys.exit(main())
