"""python -m bstcad.cli"""

from bstcad.cli import main
from bstcad.runs.child_process import end_with_parent

end_with_parent()
main()
