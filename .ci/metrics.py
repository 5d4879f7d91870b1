"""Reads OpenMetrics from standard input, and fails unless it has every metric that the named files ask for."""

import re
import sys

from prometheus_client.openmetrics.parser import text_fd_to_metric_families

families = list(text_fd_to_metric_families(sys.stdin))
described = {family.name for family in families}

for path in sys.argv[1:]:
    with open(path, encoding="utf-8") as file:
        asked = set(re.findall(r"\bseese3_[a-z0-9_]+", file.read()))

    # A histogram's parts, and a counter's total, are described under the name without its ending.
    for name in asked:
        if re.sub(r"_(bucket|count|total)$", "", name) not in described:
            sys.exit(f"{path}: no metric {name} among {sorted(described)}")

print(f"metrics: {len(families)} families, strict OpenMetrics, and all that rules and dashboard ask for")
