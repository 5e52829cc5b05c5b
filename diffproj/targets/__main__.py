"""`python -m diffproj.targets FOLDER`: measure the bundled corners again from their photographs."""

import argparse
import sys

from diffproj.targets.examples import regenerate


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m diffproj.targets",
        description="Measure the chessboard corners that ship with diffproj again, from the 26 photographs of Debian's "
        "package opencv-doc (apt-get download opencv-doc; dpkg-deb -x opencv-doc_*.deb DIR; they are then in "
        "DIR/usr/share/doc/opencv-doc/examples/data).",
    )
    parser.add_argument("folder", help="where left01.jpg ... right14.jpg are")
    parser.add_argument("--target", help="where to write left.json and right.json (default: the package's own data)")
    options = parser.parse_args(arguments)

    def show(done: int, total: int) -> None:
        print(f"\r{done} of {total} photographs", end="" if done < total else "\n", file=sys.stderr, flush=True)

    try:
        written = regenerate(options.folder, options.target, show)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print("\n".join(map(str, written)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
