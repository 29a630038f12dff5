"""The runner schedules items, publishes outputs and keeps the ledger."""
