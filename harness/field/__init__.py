"""Tools for the records of real flights: ingest, import, replay, reconstruction, bisection and the depot."""
