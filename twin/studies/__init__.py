"""Studies: experiments of the twin over many settings and seeds, their tables, budgets and searches."""
