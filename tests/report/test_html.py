"""Pages are self-contained and escape what they are given."""

import io
from html.parser import HTMLParser

from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from probewise._words import count_with_noun
from probewise.report.html import Section, figure, page, paragraph, table
from probewise.report.words import number_text, probability_text


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


def test_numbers_are_written_as_people_read_them():
    assert number_text(-1.25, 1) == "−1.2"
    assert number_text(float("nan"), 1) == "–"
    assert number_text(-0.01, 1) == "0.0"
    assert (count_with_noun(1, "reading"), count_with_noun(2, "reading")) == ("1 reading", "2 readings")
    assert (probability_text(1e-9), probability_text(0.5), probability_text(1.0)) == ("< 0.001", "0.500", "> 0.999")


def test_many_sections_are_listed_with_links_that_lead_to_them():
    sections = [
        Section(f"chapter {k}", (), (Section("first <part>", ()), Section("second part", ()))) for k in range(2)
    ]
    made = page("t", answer="a", key_figure=figure(PNG, "key"), sections=sections)
    reader = read(made)
    links = [address for address in reader.addresses if address.startswith("#")]
    assert len(links) == 6
    assert all(made.count(f'id="{link[1:]}"') == 1 for link in links)
    assert "<h3>first &lt;part&gt;</h3>" in made
    assert "<nav" not in page("t", answer="a", key_figure=figure(PNG, "key"), sections=sections[:1])
