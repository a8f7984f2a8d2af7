"""Answer questions about a complete state graph: does it contain endless cycles, which states lead to one common chain,
and how many votes do they need?
"""
