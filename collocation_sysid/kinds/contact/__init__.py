"""Obstacles: concerns about contact, and likely mistakes in their description."""

from __future__ import annotations

from ..kind import Kind, lazy


class Contact(Kind):
    """Obstacles that touch the body."""

    name = "contact"
    declares = "Obstacle"
    topics = lazy(".feature", "TOPICS")
    guess_concerns = lazy(".feature", "guess_concerns")
    concerns = lazy(".feature", "concerns")
    described = lazy(".doubts", "obstacle_hypotheses")
    fitted = lazy(".doubts", "fit_hypotheses")


KIND = Contact()
