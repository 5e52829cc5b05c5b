"""`python -m diffproj` and the `diffproj` command."""

import sys

from diffproj.cli import main as run


def main() -> int:
    """Run the command line, or say what it needs."""
    try:
        return run()
    except KeyboardInterrupt:  # while it loads what it needs, which takes seconds
        print("diffproj: interrupted", file=sys.stderr)
        return 130
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in ("jinja2", "matplotlib", "rich"):
            raise
        print(
            f"diffproj: the command line needs {missing}: pip install {missing}, or, in the folder of diffproj's "
            "source, pip install '.[cli]'",
            file=sys.stderr,
        )
        return 1


if __name__ == "__main__":
    sys.exit(main())
