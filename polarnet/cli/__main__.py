"""python -m polarnet.cli"""

import sys

from polarnet.cli import main

sys.exit(main())
