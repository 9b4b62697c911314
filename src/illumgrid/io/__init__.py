"""Access to the disk: volumes and scenes, finished runs, exports."""
