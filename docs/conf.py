"""How the site is built: `nox -s docs`, or sphinx-build --fail-on-warning docs site."""

import shutil
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_ext"))

from sphinx.application import Sphinx  # noqa: E402

import mpfjax  # noqa: E402

project = "mpfjax"
author = "The mpfjax developers"
copyright = "the mpfjax developers"
version = release = mpfjax.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton", "mpfjax_docs"]
exclude_patterns = ["_ext", "_build"]
nitpicky = True
# Signatures name the types of other projects, whose pages the build does not ask for.
nitpick_ignore_regex = [
    ("py:.*", r"(?!mpfjax\.).*"),
    ("py:class", r"mpfjax\..*\.Abstract(BoxModel|RandomWalk)"),
    # What public classes hold or pass on, and users neither make nor read.
    ("py:class", r"mpfjax\..*\._\w+"),
    ("py:class", r"mpfjax\.tuning\.(chains|problem|densities)\.\w+"),
    ("py:class", r"mpfjax\.(moves\.conditional|running\.long_runs)\.\w+"),
    ("py:class", r"mpfjax\.moves\.resampling\.(line|ancestors)\.\w+"),
    ("py:class", r"mpfjax\.vision\.colour\.\w+"),
    ("py:class", r"mpfjax\.vision\.tracking\.(associate|camera|gaussian|lives)\.\w+"),
    ("py:class", r"mpfjax\.vision\.tracking\.(detections\.Kind|noise\.\w+|scores\.\w+)"),
    ("py:class", r"mpfjax\.(mixture\.Within|models\.law\.Law)"),
]

html_theme = "furo"
html_title = f"mpfjax {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_math_renderer = "mathml"
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5e8a", "color-brand-content": "#0b5e8a"},
    "dark_css_variables": {"color-brand-primary": "#6cb8e6", "color-brand-content": "#6cb8e6"},
}

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
suppress_warnings = ["mystnb.unknown_mime_type"]
nb_execution_mode = "off"  # the notebooks are shown with the outputs that they hold
nb_merge_streams = True

add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {
    "members": True,
    # What every move has of its kind; the kinds themselves show it.
    "exclude-members": "regroup, initial_memory",
}
maximum_signature_line_length = 80
python_use_unqualified_type_names = True
copybutton_prompt_text = "$ "


def _copy_notebooks() -> None:
    """The notebooks live at the top of the repository; Sphinx reads what is below docs/ alone."""
    shown = HERE / "notebooks"
    shown.mkdir(exist_ok=True)
    for path in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        copy = shown / path.name
        if not copy.exists() or copy.read_bytes() != path.read_bytes():
            shutil.copyfile(path, copy)
    kept = {path.name for path in (HERE.parent / "notebooks").glob("*.ipynb")}
    for path in shown.glob("*.ipynb"):
        if path.name not in kept:
            path.unlink()


_copy_notebooks()


def _keep_outputs_apart(app: Sphinx) -> None:
    """The notebooks' pictures wait beside the doctrees, and not beside the site."""
    outputs = Path(app.doctreedir).parent / "outputs"
    app.env.mystnb_config = app.env.mystnb_config.copy(output_folder=str(outputs))


def setup(app: Sphinx) -> None:
    """After MyST-NB has made its settings."""
    app.connect("builder-inited", _keep_outputs_apart, priority=900)
