"""Fixes to programs that are already there: one address says which, and where.

An edge of its own: it knows fixes, and nothing of cameras, recordings or robots.
"""

from fingerpost.publishing.fix import Extent, Pictures, PublishedFix
from fingerpost.publishing.publisher import Publisher
from fingerpost.publishing.registry import SCHEMES, open_publisher

__all__ = ["SCHEMES", "Extent", "Pictures", "PublishedFix", "Publisher", "open_publisher"]
