"""Publishes fixes to other programs; an address selects protocol and receiver.

It only depends on fixes, not on cameras, recordings or robots.
"""

from fingerpost.publishing.fix import Extent, Pictures, PublishedFix
from fingerpost.publishing.publisher import Publisher
from fingerpost.publishing.registry import SCHEMES, open_publisher

__all__ = ["SCHEMES", "Extent", "Pictures", "PublishedFix", "Publisher", "open_publisher"]
