"""Studies: experiments over many settings and seeds, their tables, budgets and searches."""
