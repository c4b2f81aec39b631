"""``python -m pemviz`` is the command line."""

import sys

from pemviz.cli.main import main

sys.exit(main())
