"""Receives COUNT scans of a sensor, and then prints for each the age of its telegram's last byte on receipt:
`aged SENSOR NS`. Arguments: DOMAIN SENSOR COUNT."""

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
