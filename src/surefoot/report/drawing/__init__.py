"""Robots drawn in software: scene, renderer, video."""
