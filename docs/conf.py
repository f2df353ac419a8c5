"""The documentation: `make docs` writes it to docs/_build/html, complete without a network."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_ext")]

from gallery_pictures import pictures

import bstcad

project, author, copyright = "bstcad", "the authors of bstcad", "the authors of bstcad"
version = release = bstcad.__version__
extensions = [
    "myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton", "sphinx_design",
    "sphinx_gallery.gen_gallery", "reference_pages", "tutorial_runs",
]  # fmt: skip
exclude_patterns = ["_build", "_made", "gallery-scripts", "**/*.ipynb"]
nitpicky = False
html_theme = "furo"
html_title = f"bstcad {release}"
html_static_path = ["_static"]
html_css_files = ["bstcad.css"]
html_copy_source = html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}
myst_enable_extensions = ["colon_fence", "attrs_inline"]
myst_heading_anchors = 4
python_use_unqualified_type_names = True
maximum_signature_line_length = 110
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autoclass_content = "class"
sphinx_gallery_conf = {
    "examples_dirs": "gallery-scripts",
    "gallery_dirs": "gallery",
    "image_scrapers": (pictures,),
    "filename_pattern": "/lens_",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "reset_modules": (),
    "abort_on_example_error": True,
    "remove_config_comments": True,
    "copyfile_regex": r".*\.(toml|jpg|png)",
    "write_computation_times": False,
}
suppress_warnings = ["config.cache"]
