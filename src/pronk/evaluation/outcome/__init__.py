"""What a trial came to: tables, bars, the paper's figures beside ours."""
