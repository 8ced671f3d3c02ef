"""Recordings and logs of other formats to survey bags."""
