"""python -m bstcad.cli"""

from bstcad.cli import main

main()
