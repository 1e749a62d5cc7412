"""Reads scans of a simulated RPLIDAR with the vendor's driver. Arguments: PORT BAUD SCANS. Prints one line of JSON: the
model, the health, and for each scan the angles (radians) and the ranges (meters)."""

import json
import sys

from pyrplidarsdk import RplidarDriver

driver = RplidarDriver(port=sys.argv[1], baudrate=int(sys.argv[2]))
assert driver.connect(), "it does not connect"
info, health = driver.get_device_info(), driver.get_health()
assert driver.start_scan(), "it does not start"
scans, tries = [], 0
while len(scans) < int(sys.argv[3]) and tries < 100:
    tries += 1
    scan = driver.get_scan_data()
    if scan and scan[0]:
        scans.append([scan[0], scan[1]])
# Before the end, where the driver can crash on a busy machine.
print(json.dumps({"model": info.model, "health": str(health.status), "scans": scans}), flush=True)
driver.stop_scan()
driver.disconnect()
