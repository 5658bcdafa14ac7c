"""The families of cases by name."""

from tests.campaign.full_disk import FULL_DISK
from tests.campaign.kills import KILLS
from tests.campaign.mutations import MUTATIONS
from tests.campaign.signals import SIGNALLED
from tests.campaign.two_processes import TWO_PROCESSES

FAMILIES = {
    "kills": KILLS,
    "full_disk": FULL_DISK,
    "mutations": MUTATIONS,
    "signals": SIGNALLED,
    "two_processes": TWO_PROCESSES,
}
