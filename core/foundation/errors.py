"""The one error that a user can mend. Everything else that is raised is a bug of ours."""

LONGEST = 1500


class InputError(Exception):
    """The input needs mending. The message is one sentence: what is wrong, which input it is, and what to do.

    What it quotes from a damaged or foreign file is made fit for a terminal: no control characters, no endless lines.
    """

    def __init__(self, message: str = "") -> None:
        text = "".join(c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in str(message))
        super().__init__(text if len(text) <= LONGEST else text[: LONGEST // 2] + " … " + text[-LONGEST // 2 :])
