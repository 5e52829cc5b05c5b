"""Builds the site: `python .docs/build.py [FOLDER]`, by default in build/docs. Needs the extra `docs`.

The pages are the Markdown files beside this one, in the order of `index.md`, and those of the interface: one for
`diffproj.__all__` and one for each room, out of the docstrings. In the Markdown `dp.calibrate` is a link to its
page, `choosing.md` to the page beside, `../tests` to the repository. Any warning is an error.
"""

import re
import sys
import warnings
from pathlib import Path
from types import ModuleType

import pdoc
import pdoc.docstrings
import pdoc.extract
import pdoc.render

import diffproj as dp

HERE = Path(__file__).parent
REPOSITORY = "https://github.com/diffproj/diffproj/blob/main/"
ROOMS_WITHOUT_PAGES = ("cli",)  # its --help tells more
PLACES = {"figures": "diffproj/figures.html", "synthetic": "diffproj/targets/synthetic.html"}
"""Modules that are public names by themselves, and their pages."""


def pages() -> list[Path]:
    """The Markdown files: the first page, and those that it links to in their order."""
    first = HERE / "index.md"
    linked = re.findall(r"\]\((\w+\.md)\)", first.read_text(encoding="utf-8"))
    return [first, *(HERE / name for name in dict.fromkeys(linked))]


def title_of(page: Path) -> str:
    """The heading of a page."""
    return page.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def place_of(name: str) -> str:
    """Where on the site a public name such as `dp.Camera.mounted` is told of.

    Raises:
        AttributeError: there is no such name.
    """
    found: object = dp
    parts = name.split(".")[1:]
    for part in parts:
        fields = getattr(found, "__annotations__", {})
        if not hasattr(found, part) and part in fields:
            break
        found = getattr(found, part)
    if parts[0] in PLACES:
        return PLACES[parts[0]] + (f"#{'.'.join(parts[1:])}" if parts[1:] else "")
    return f"diffproj.html#{'.'.join(parts)}"


def linked(text: str, up: str) -> str:
    """A page's text with its links as the site has them; `up` leads from the page to the site's first folder."""
    fence = re.compile(r"(```.*?```)", re.DOTALL)
    return "".join(part if part.startswith("```") else _linked(part, up) for part in fence.split(text))


def _linked(text: str, up: str) -> str:
    text = re.sub(r"\]\(\.\./", f"]({REPOSITORY}", text)
    text = re.sub(r"(?<!\[)`(dp(?:\.[A-Za-z_]\w*)+)([^`]*)`", lambda m: f"[`{m[1]}{m[2]}`]({up}{place_of(m[1])})", text)
    return re.sub(
        r"\]\((\w+)\.md(#[\w-]*)?\)",
        lambda m: f"]({up}{'guide' if m[1] == 'index' else f'guide/{m[1]}'}.html{m[2] or ''})",
        text,
    )


def module_of(page: Path) -> pdoc.doc.Module:
    """A page as what pdoc takes: a module without names."""
    name = "guide" if page.stem == "index" else f"guide.{page.stem}"
    module = ModuleType(name)
    text = pdoc.docstrings.embed_images(page.read_text(encoding="utf-8"), page)
    module.__doc__ = linked(text, "../" * name.count("."))
    module.__all__ = []
    module.__title__ = "Start" if page.stem == "index" else title_of(page)
    sys.modules[name] = module
    return pdoc.doc.Module(module)


def main(folder: Path) -> None:
    """Write the site."""
    warnings.simplefilter("error")
    rooms = [
        f"diffproj.{path.parent.name}"
        for path in sorted(Path(dp.__file__).parent.glob("[a-z]*/__init__.py"))
        if path.parent.name not in ROOMS_WITHOUT_PAGES
    ]
    names = pdoc.extract.walk_specs(["diffproj", "diffproj.figures", *rooms, r"!diffproj\.\w+\.(?!synthetic)"])
    guide = [module_of(page) for page in pages()]
    modules = {module.fullname: module for module in guide}
    modules |= {name: pdoc.doc.Module.from_name(name) for name in names}
    pdoc.render.configure(
        docformat="google", template_directory=HERE / "theme", footer_text=f"diffproj {dp.__version__}"
    )
    for name, module in modules.items():
        file = folder / f"{name.replace('.', '/')}.html"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(pdoc.render.html_module(module, modules), encoding="utf-8")
    (folder / "index.html").write_text(
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>diffproj</title>'
        '<meta http-equiv="refresh" content="0; url=guide.html"><a href="guide.html">diffproj</a></html>\n',
        encoding="utf-8",
    )
    (folder / "search.js").write_text(pdoc.render.search_index(modules), encoding="utf-8")


if __name__ == "__main__":
    place = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE.parent / "build" / "docs"
    main(place)
    print(place / "index.html")
