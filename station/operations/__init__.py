"""What an operator starts by hand: batches, reprocessing, checks, SOPs and reports."""
