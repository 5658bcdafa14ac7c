"""Results on the disk at a glance, read from their records alone: no jax, nothing computed.

kinds         what a folder holds, by its record
numbers       the main numbers of a folder, and on which side each is good
listing       folders of results below others: kind, state, main numbers, size, cost
comparing     specs and main numbers of several folders side by side
pictures      the picture of a folder to look at first, and all that can be shown of it
"""
