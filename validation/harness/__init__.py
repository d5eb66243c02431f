"""One way to run every stage of ours and of the references on the same inputs, and to tell of it."""
