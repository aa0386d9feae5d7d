"""What a run needs that is neither model nor data: settings read and checked, progress drawn, threads limited."""
