"""Heights that a process can make.

parametrize   free parameters -> heights on a staircase
quantisation  ways to round to levels in the loop
printable     level maps whose masks obey the rules of lithography at every step
etch_depths   etch depths that suit a design
"""
