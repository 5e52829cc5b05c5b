"""The guide's pages: their code gives what it says, and their links lead to what is there."""

import doctest
import importlib.util
import io
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted((ROOT / ".docs").glob("*.md"))


def code_of(page: Path) -> str:
    return "\n".join(re.findall(r"```pycon\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL))


@pytest.mark.parametrize("page", [page for page in PAGES if code_of(page)], ids=lambda page: page.stem)
def test_code_gives_what_the_page_says(page: Path) -> None:
    test = doctest.DocTestParser().get_doctest(code_of(page), {}, page.name, str(page), 0)
    said = io.StringIO()
    doctest.DocTestRunner(verbose=False, optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=said.write)
    assert len(test.examples) > 3
    assert not said.getvalue(), said.getvalue()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_to_what_is_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\((?!https?:)([^)]+)\)", text):
        path, _, part = link.partition("#")
        target = (page.parent / path) if path else page
        assert target.exists(), link
        headings = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.MULTILINE) if part else []
        anchors = [re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings]
        assert not part or part in anchors, link


def test_the_first_page_leads_to_all_others() -> None:
    linked = re.findall(r"\]\((\w+\.md)\)", (ROOT / ".docs" / "index.md").read_text(encoding="utf-8"))
    assert {*linked, "index.md"} == {page.name for page in PAGES}


@pytest.fixture(scope="module")
def build() -> ModuleType:
    """The program that builds the site."""
    pytest.importorskip("pdoc", reason="the extra docs is not installed")
    spec = importlib.util.spec_from_file_location("build", ROOT / ".docs" / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_names_lead_to_the_interface(page: Path, build: ModuleType) -> None:
    text = page.read_text(encoding="utf-8")
    shown = build.linked(text, "../")
    assert shown.count("](../diffproj") == len(
        re.findall(r"(?<!\[)`dp\.[A-Za-z_]", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    )


def test_names_that_are_not_there_are_refused(build: ModuleType) -> None:
    assert build.place_of("dp.Camera.mounted") == "diffproj.html#Camera.mounted"
    assert build.place_of("dp.figures.accuracy") == "diffproj/figures.html#accuracy"
    with pytest.raises(AttributeError):
        build.place_of("dp.Camera.mouted")


@pytest.mark.slow
def test_no_link_of_the_site_leads_nowhere(build: ModuleType, tmp_path: Path) -> None:
    build.main(tmp_path)
    files = {path.resolve(): path.read_text(encoding="utf-8") for path in tmp_path.rglob("*.html")}
    assert len(files) > 15
    for path, text in files.items():
        for link in set(re.findall(r'href="([^"#:]*\.html)?(?:#([^"]*))?"', text)):
            target = (path.parent / link[0]).resolve() if link[0] else path
            assert target in files, (path.name, link)
            if link[1] and path.parent.name == "guide":
                assert f'id="{link[1]}"' in files[target], (path.name, link)
