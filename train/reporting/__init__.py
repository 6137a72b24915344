"""What came out, for people: lines on the terminal, figures, videos, pages, and the paper's numbers
and claims beside ours."""
