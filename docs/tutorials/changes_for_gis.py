"""Take a change directory into your own analysis: table, footprints, points, settings.

python docs/tutorials/changes_for_gis.py CHANGE_DIR
"""

import sys

import subiaco

changes = subiaco.open_changes(sys.argv[1])
table = changes.table

# What was compared, and how sure the registration is.
print(
    f"compared in {table.crs.to_string()}: sigma of the registration "
    f"{1e3 * changes.directory.registration['sigma_reg_m']:.1f} mm"
)

# Area and volume by label, of rows that are surer than 0.7.
sure = table[table["confidence"] > 0.7]
print(sure.assign(area_m2=sure.area).groupby("label")[["area_m2", "delta_v_m3"]].sum().round(1).to_string())

# Footprints buffered by 5 m, for a field crew.
visits = sure[sure["label"].isin(["Added", "Removed"])].copy()
visits["geometry"] = visits.buffer(5.0)
print(f"{len(visits)} places to visit, {visits.union_all().area:.0f} m2")

# Heights of the points of the largest change.
if len(visits):
    largest = visits.loc[visits["delta_v_m3"].abs().idxmax()]
    epoch = "after" if largest["label"] == "Added" else "before"
    heights = changes.points(int(largest["object_id"]), epoch)[:, 2]
    print(f"object {largest['object_id']} reaches from {heights.min():.1f} to {heights.max():.1f} m")
