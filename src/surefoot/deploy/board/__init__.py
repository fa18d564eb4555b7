"""The board between control loop and motors: sessions, arming, limits, and damping when the operator is silent."""
