"""Pictures, films and views of what a run made."""
