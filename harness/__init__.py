"""The harness: scenarios, the orchestrator, the checker, the report and the command line."""
