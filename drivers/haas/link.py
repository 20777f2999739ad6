"""One TCP connection to a Haas control: one query at a time, among answers that others have asked for."""

from collections.abc import Callable

from drivers.haas.codec import Answer, HaasFormatError, LineBuffer, Query, Unknown, parse_answer
from drivers.linked_cnc import AnsweredLink

Fits = Callable[[Answer], bool]


class HaasLink(AnsweredLink[Answer]):
    """What the control answers goes to all who are connected, so an answer counts only where it fits a query.

    A control that names the variable in its answers tells whose they are: another's are passed over. One that does not
    leaves only the order, so there everything that was not asked for ends the connection.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._buffer = LineBuffer()
        self._fits: Fits | None = None
        self._taken: dict[int, float | None] = {}
        self.numbered: bool | None = None
        """Whether answers name their variable; None until the first one."""
        self.contradicted = False
        """Two answers for the same variable have differed since `begin`."""
        self.not_understood = False
        """The control has answered since `begin` that it does not understand a line, this client's or another's."""

    def data_received(self, data: bytes) -> None:
        """Take every answer that these bytes complete."""
        try:
            for line in self._buffer.feed(data):
                if self.lost is None:
                    self._take(parse_answer(line))
        except HaasFormatError as error:
            self.abort(f"{self._name} gave an answer that cannot be: {error}")

    def begin(self) -> None:
        """Begin a batch: what was taken before contradicts nothing."""
        self._taken.clear()
        self.contradicted = self.not_understood = False

    async def ask(self, lines: bytes, fits: Fits) -> Answer:
        """Send lines and return the first answer that fits; given up, it ends the link. Raises LinkError."""
        self._fits = fits
        try:
            return await self._answer_to(lines)
        finally:
            self._fits = None

    def _take(self, answer: Answer | Unknown | None) -> None:
        if isinstance(answer, Unknown):
            self.not_understood = True
        if not isinstance(answer, Answer):
            return
        if answer.query is Query.MACRO and not self._one_form(answer):
            return
        if answer.number is not None and answer.number in self._taken:
            known = self._taken[answer.number]
            self.contradicted |= known != answer.value
        if self._waiting is not None and not self._waiting.done() and self._fits is not None and self._fits(answer):
            if answer.number is not None:
                self._taken[answer.number] = answer.value
            self._waiting.set_result(answer)
        elif self.numbered is False:
            self.abort(
                f"{self._name} names no macro variable in its answers, and gave one that nothing was asked for: end "
                "the other client, the daemon must be the only one there"
            )

    def _one_form(self, answer: Answer) -> bool:
        numbered = answer.number is not None
        if self.numbered is None:
            self.numbered = numbered
        if self.numbered != numbered:
            self.abort(f"{self._name} names the macro variable in some answers and not in others")
        return self.numbered == numbered


def is_value(answer: Answer, number: int) -> bool:
    """Return whether an answer is the value of a macro variable, as far as it says."""
    return answer.query is Query.MACRO and (answer.number is None or answer.number == number)
