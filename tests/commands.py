"""Commands as a user types them."""

from ms_highway.cli.main import main


def run(command: str) -> None:
    """Run a command of words with a single space between them, which has to succeed."""
    assert main(command.split(" ")) == 0
