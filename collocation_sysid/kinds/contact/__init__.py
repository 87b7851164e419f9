"""Obstacles: concerns about contact, and likely mistakes in their description."""

from __future__ import annotations

from ..kind import Kind, lazy


class Contact(Kind):
    """Obstacles that touch the body."""

    name = "contact"
    declares = "Obstacle"
    topics = lazy(".concerns", "TOPICS")
    guess_concerns = lazy(".concerns", "guess_concerns")
    concerns = lazy(".concerns", "concerns")
    described = lazy(".doubts", "obstacle_hypotheses")
    fitted = lazy(".doubts", "fit_hypotheses")


KIND = Contact()
