"""Follows the scans of a sensor until so many came, then prints for each how old its telegram's last byte was when the
sample was in hand: `aged SENSOR NS`. Arguments are domain, sensor and count."""

import sys
import time

import scanhub

domain, sensor, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
ages = []
scans = scanhub.subscribe(f"{sensor}/scan", domain=domain)
print(f"attaching {sensor}", flush=True)
for scan in scans:
    ages.append(time.monotonic_ns() - scan.stamp_last_ns)
    if len(ages) == count:
        break
for age in ages:
    print(f"aged {sensor} {age}")
print("end")
