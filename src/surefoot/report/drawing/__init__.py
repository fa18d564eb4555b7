"""Software rendering of robots: scene, renderer, video."""
