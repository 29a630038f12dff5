"""The runner: schedules items, publishes outputs, keeps the ledger."""
