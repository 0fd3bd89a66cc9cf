"""Files and pages for others: what they weigh, and how far what they show is from our own picture."""
