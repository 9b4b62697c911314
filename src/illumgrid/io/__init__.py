"""What is on disk: volumes and scenes, finished runs, exports."""
