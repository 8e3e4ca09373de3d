"""What the model gets wrong: the cause, by evidence on windows that were held out, and what stays unexplained."""
