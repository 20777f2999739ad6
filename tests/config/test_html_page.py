"""Pages: every text is escaped, tables have their cells, a page for paper lets nothing run."""

from html.parser import HTMLParser

from config.html_page import Section, html_page


class Page(HTMLParser):
    """Collects tags and texts; complains about tags that do not close."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.texts: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.append(tag)
        if tag != "meta":
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip() and self._open[-1] != "style":
            self.texts.append(data.strip())


EVIL = "<script>alert('&')</script>"


def test_every_text_is_escaped_wherever_it_stands() -> None:
    section = Section(
        title=EVIL, text=EVIL, items=(EVIL,), head=(EVIL,), rows=((EVIL,),), caption=EVIL, picture="<svg></svg>"
    )
    page = Page(html_page(EVIL, [section]))
    assert "script" not in page.tags
    assert page.texts == [EVIL] * 8, "title twice, heading, paragraph, list, head, cell, caption"
    assert page.tags.count("svg") == 1


def test_a_page_for_paper_lets_a_browser_run_nothing() -> None:
    assert "default-src 'none'" in html_page("t", [], paper=True)
    assert "Content-Security-Policy" not in html_page("t", [])
