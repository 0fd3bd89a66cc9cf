"""Nouns: frozen records of what a scene is made of. Nothing here renders, trains or talks to a network."""
