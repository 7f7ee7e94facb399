"""The ablation study: rows, their training in worker processes, what each is measured by, the table (arXiv:2105.10441, section 4.3)."""
