"""The Uniform Chain Protocol: blocks, chain, messages, and the 20 event handlers of Algorithms 1-20."""
