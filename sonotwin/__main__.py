"""The command, as `sonotwin` or `python -m sonotwin`: checks that our packages are the ones found, then runs the command line."""

import sys

from sonotwin import namesakes


def main() -> int:
    """Run the command line; returns the exit status, 2 where another distribution's package hides one of ours."""
    for place in namesakes.places(("recon", "scenes", "twin")):
        if place.hidden:
            print(f"sonotwin: {place.name}: expected {place.ours}, found {place.found}; {place.remedy}", file=sys.stderr)
            return 2
    from sonotwin import cli

    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
