"""Answer questions about a complete state graph: endless cycles, ways to one common chain, and the votes that they
need.
"""
