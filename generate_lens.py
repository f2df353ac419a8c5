"""From a scene file to a lens: python generate_lens.py templates/thu.toml (takes what `bstcad generate` takes)."""

import sys

from bstcad.cli import main

main(["generate", *sys.argv[1:]])
