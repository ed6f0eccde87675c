"""The kinds of procedural maps, a module each, and what several of them share."""
