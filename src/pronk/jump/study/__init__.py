"""Many trainings and trials at once: tasks, where they run, studies and their statistics."""
