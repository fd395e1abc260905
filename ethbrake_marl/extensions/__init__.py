"""What can be deleted: each folder registers itself by entry points, and no core module names one."""
