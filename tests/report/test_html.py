"""Pages are self-contained and escape what they are given."""

import io
from html.parser import HTMLParser

from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from probewise.report.html import Section, figure, page, paragraph, table


def png(size, dpi=None):
    out = io.BytesIO()
    Image.new("RGB", size).save(out, "PNG", **({} if dpi is None else {"dpi": (dpi, dpi)}))
    return out.getvalue()


PNG = png((3, 2))


class Reader(HTMLParser):
    """Collect text and addresses, and check that every element is closed in order."""

    VOID = frozenset({"meta", "img", "br", "input"})

    def __init__(self):
        super().__init__()
        self.open, self.text, self.addresses = [], [], []

    def handle_starttag(self, tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(markup):
    reader = Reader()
    reader.feed(markup)
    reader.close()
    assert reader.open == []
    return reader


@given(st.text(alphabet=st.characters(exclude_categories=("Cs", "Cc"))))
def test_text_comes_out_as_it_went_in_whatever_it_holds(text):
    assert "".join(read(paragraph(text)).text) == text


def test_a_page_needs_nothing_from_outside():
    made = page(
        "a <title>",
        answer="5 < 6",
        key_figure=figure(PNG, 'a "caption"'),
        sections=[Section("more", (table(("a", "b"), [("1", "<x>")]),))],
    )
    reader = read(made)
    assert all(address.startswith("data:") for address in reader.addresses)
    assert "5 < 6" in "".join(reader.text)
    assert "://" not in made
    assert 'name="viewport"' in made
