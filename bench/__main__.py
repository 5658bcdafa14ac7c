"""Every benchmark in turn, each in a process of its own so that neither memory nor caches carry over."""

import subprocess
import sys

TABLES = (
    "bench.psf",
    "bench.edges",
    "bench.lens",
    "bench.step",
    "bench.schedule",
    "bench.robust",
    "bench.masks",
    "bench.rules",
    "bench.solids",
    "bench.order",
    "bench.plate",
    "bench.capture",
    "bench.train",
    "bench.pipeline",
    "bench.spots",
    "bench.areas",
    "bench.focus",
)


def main() -> int:
    """Print every table; arguments such as `psf` choose some. Return 1 if a benchmark could not run."""
    chosen = [f"bench.{name}" for name in sys.argv[1:]] or TABLES
    unknown = sorted(set(chosen) - set(TABLES))
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; there are {', '.join(TABLES)}", file=sys.stderr)
        return 2
    failed = 0
    for table in chosen:
        print(f"\n== {table}", flush=True)
        failed |= subprocess.run([sys.executable, "-m", table], check=False).returncode != 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
