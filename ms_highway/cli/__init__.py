"""Offer the command ``ms-highway``, a file per subcommand.

Imports anything; nothing imports it.
"""
