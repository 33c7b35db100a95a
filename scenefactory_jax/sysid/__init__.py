"""System identification: a validated car drives manoeuvres, ours is fitted until it drives them likewise."""
