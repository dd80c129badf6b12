"""`sonotwin navigate`: its command line, and what its messages say. Needs neither Slicer nor sonotwin."""

import shlex

PORT = 18944  # that is registered for OpenIGTLink
STATUS, DISTANCES, TOOLS = TEXTS = ("Status", "Distances", "Tools")
SCAN, TARGET = "BScan", "TargetToRAS"
IN_TARGET = "Probe"  # the model that comes in the target's frame


def command(program, fields, port):
    """Program and arguments of `sonotwin navigate` that sends to a port of this computer.

    fields : as typed in a shell, `capture=outputs/live/capture lag_s=0.05`

    Raises
    ------
    ValueError
        If there is no program, neither capture nor devices are named, or quotes are left open.
    """
    if not program:
        raise ValueError("program: expected sonotwin's, such as .venv/bin/sonotwin, found none")
    try:
        given = shlex.split(fields)
    except ValueError as error:
        raise ValueError(f"fields: expected words as in a shell, found {fields!r} ({error})") from None
    names = [field.partition("=")[0] for field in given]
    if "igtl.port" in names:
        raise ValueError("fields: expected the port in its own box, found igtl.port, too")
    if not {"capture", "devices"} & set(names):
        raise ValueError("fields: expected capture=FOLDER or devices=NAME, found neither")
    return [program, "navigate", *given, f"igtl.port={port}"]


def status(texts, seconds):
    """Lines for the panel, of texts by their messages' names and of the time, s, since the last moment came; None without one."""
    if seconds is None:
        return ["nothing has come yet"]
    lines = [f"nothing has come for {seconds:.0f} s: what is shown is old"] if seconds > 2 else []
    return lines + [texts[name] for name in TEXTS if texts.get(name)]
