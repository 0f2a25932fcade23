"""What ``tools.benchmark`` is made of: logs, systems to run, their scores, and the reports."""
