"""The document: whole, well-formed, closed to the network, and deaf to what names try to do."""

import base64
import hashlib
import json
import re

import pytest

from diffproj.report.document import Part, document, json_block, shortened
from tests.report.outline import HOSTILE, Outline


def parts() -> list[Part]:
    return [
        Part("First", "first", "<p>One.</p>", style=".first { color: var(--good); }", script="window.first = 1;"),
        Part(HOSTILE, "second", "<p>Two.</p>", script="window.second = 2;"),
    ]


def test_a_document_is_well_formed_and_outlined() -> None:
    page = Outline(document("A camera", parts()))
    assert page.texts["h1"] == ["A camera"]
    assert page.texts["h2"] == ["First", shortened(HOSTILE)]
    links = [a["href"] for tag, a in page.elements if tag == "a"]
    names = {a["id"] for tag, a in page.elements if "id" in a}
    assert links == ["#content", "#first", "#second"]
    assert all(link[1:] in names for link in links if link)


def test_styles_and_scripts_are_those_that_the_policy_names() -> None:
    page = Outline(document("A camera", parts()))
    policy = next(a["content"] for _, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    for tag in ("style", "script"):
        hashes = [f"'sha256-{base64.b64encode(hashlib.sha256(t.encode()).digest()).decode()}'" for t in page.texts[tag]]
        assert len(hashes) == 2
        assert f"{tag}-src {' '.join(hashes)};" in policy
    assert policy.startswith("default-src 'none'; img-src data: blob:;")
    assert "unsafe" not in policy
    assert "http" not in policy


def test_a_document_without_scripts_allows_none() -> None:
    assert "script-src 'none'" in document("A camera", [Part("First", "first", "<p>One.</p>")])


def test_titles_are_text() -> None:
    page = Outline(document(HOSTILE, parts()))
    assert page.texts["title"] == page.texts["h1"] == [shortened(HOSTILE)]
    assert not [a for tag, a in page.elements if tag == "img"]
    assert not [name for _, a in page.elements for name in a if name.startswith("on")]
    assert len(page.texts["script"]) == 2


def test_what_is_no_text_is_a_question_mark() -> None:
    page = document("caf\udce9", parts())
    assert Outline(page).texts["h1"] == ["caf?"]
    page.encode()


def test_long_titles_lose_their_middle() -> None:
    page = Outline(document("x" * 1000 + "y", parts()))
    assert len(page.texts["h1"][0]) == 300
    assert page.texts["h1"][0].endswith("y")
    assert shortened("a\n b\t c") == "a b c"
    assert [len(shortened("0123456789", n)) for n in (9, 8, 5, 3)] == [9, 8, 5, 3]


def test_data_comes_back_whole_and_cannot_end_its_element() -> None:
    value = {"name": HOSTILE, "numbers": [1.5, None]}
    block = str(json_block("data", value))
    assert block.count("<") == block.count(">") == 2
    inside = re.fullmatch(r"<script[^>]*>(.*)</script>", block)
    assert inside is not None
    assert json.loads(inside[1]) == value
    with pytest.raises(ValueError, match="JSON compliant"):
        json_block("data", [float("nan")])


@pytest.mark.parametrize("wrong", [[], ["a", "a"], ["A b"], ['a"'], [""]])
def test_anchors_are_words_that_differ(wrong: list[str]) -> None:
    with pytest.raises(ValueError, match="parts: want at least one, with anchors that differ"):
        document("A camera", [Part("First", anchor, "") for anchor in wrong])


@pytest.mark.parametrize("wrong", [{"style": "a{} </STYLE>"}, {"script": "'</script>'"}, {"script": "1 <!-- 2"}])
def test_no_part_ends_its_own_style_or_script(wrong: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="want text without"):
        document("A camera", [Part("First", "first", "", **wrong)])


def test_a_document_names_no_address() -> None:
    assert not re.search(r"https?:|//[a-z]", document("A camera", parts()))
