"""The one error that a user can mend. Everything else that is raised is a bug of ours."""


class InputError(Exception):
    """The input needs mending. The message is one sentence: what is wrong, which input it is, and what to do."""
