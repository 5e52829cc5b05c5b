"""`python -m diffproj` and the `diffproj` command."""

import sys


def main() -> int:
    """Run the command line, or say what it needs."""
    try:
        from diffproj.cli import main as run
    except ModuleNotFoundError as error:
        if error.name not in ("matplotlib", "rich"):
            raise
        print(f"diffproj: the command line needs {error.name}; pip install 'diffproj[cli]'", file=sys.stderr)
        return 1
    return run()


if __name__ == "__main__":
    sys.exit(main())
