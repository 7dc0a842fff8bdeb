"""Films the simulator's balls by cameras over a table, with their true states beside the videos."""
