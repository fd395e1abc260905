"""Extensions: folders that can be deleted. Each registers itself by entry points; no core module names one."""
