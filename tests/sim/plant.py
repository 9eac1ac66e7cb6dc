"""Plants one fault into each formula of the sim package, as modules of its test binary.

    python3 tests/sim/plant.py; cargo test --release -p wildcity-sim --test sim -- planted; git checkout tests/sim/main.rs

Each module mNN has a copy of the package's file with one fault, and a copy of the tests of the vectors that use it. Every
module must have a test that fails; one without is a fault that no vector notices. Nothing of it is committed.
"""
import re,os,shutil,json
from pathlib import Path

R = Path(__file__).resolve().parents[2]
src=lambda p: open(f'{R}/{p}').read()
M=[
('footprint.rs','let gap_m = along_m.abs() - self.radius_m(axis) - other.radius_m(axis);','let gap_m = along_m.abs() - self.radius_m(axis) - 0.9 * other.radius_m(axis);'),
('footprint.rs','[self.forward, self.left(), other.forward, other.left()]','[self.forward, self.left(), self.forward, self.left()]'),
('footprint.rs','pub const TOUCH_M: f64 = 1e-10;','pub const TOUCH_M: f64 = 1e-8;'),
('footprint.rs','pub const TOUCH_M: f64 = 1e-10;','pub const TOUCH_M: f64 = -1e-8;'),
('footprint.rs','ahead_m.hypot(aside_m)','ahead_m.max(aside_m)'),
('footprint.rs','from_own.chain(from_other)','from_own.chain(from_other).take(4).map(|d| d + 0.01)'),
('footprint.rs','if gap_m > widest.0','if gap_m < widest.0 || widest.0 == f64::NEG_INFINITY'),
('body.rs','center.z + size.height_m','center.z + 2.0 * size.height_m'),
('body.rs','self.is_level_with(other) && self','self'),
('sweep.rs','first_s.max(times_s[0].min(times_s[1]))','first_s.min(times_s[0].min(times_s[1]))'),
('sweep.rs','last_s.min(times_s[0].max(times_s[1]))','last_s.max(times_s[0].max(times_s[1]))'),
('sweep.rs','(last_s >= 0.0).then_some','(last_s >= -1e9).then_some'),
('sweep.rs','b.velocity_mps - a.velocity_mps','b.velocity_mps'),
('sweep.rs','if along_m.abs() > reach_m','if along_m.abs() > 2.0 * reach_m'),
('fault.rs','input.ego_velocity_mps.length() <= STANDING_MPS','input.ego_velocity_mps.length() <= -1.0'),
('fault.rs','> -input.other_velocity_mps.dot(normal)','>= -input.other_velocity_mps.dot(normal)'),
('fault.rs','> -input.other_velocity_mps.dot(normal)','> input.other_velocity_mps.dot(normal)'),
('fault.rs','Self::StoppedTrack | Self::ActiveFront => true','Self::StoppedTrack => true, Self::ActiveFront => false'),
('solid.rs','SOLID_OPACITY: f64 = 0.5','SOLID_OPACITY: f64 = 0.3'),
('solid.rs','SIDE_MARGIN_M: f64 = 0.1','SIDE_MARGIN_M: f64 = 0.0'),
('solid.rs','GROUND_MARGIN_M: f64 = 0.3','GROUND_MARGIN_M: f64 = 0.1'),
('solid.rs','FREE_AREA_M2: f64 = 0.05','FREE_AREA_M2: f64 = 0.03'),
('solid.rs','2.0 * self.most_on_drive_m2','self.most_on_drive_m2'),
('solid.rs','self.opacity * PI * longest','PI * longest'),
('solid.rs','(a * b).max(a * c).max(b * c)','(a * b).min(a * c).min(b * c)'),
('detector.rs','MAX_SWEPT_SPEED_MPS: f64 = 60.0','MAX_SWEPT_SPEED_MPS: f64 = 1e9'),
('detector.rs','MAX_SWEPT_SPEED_MPS: f64 = 60.0','MAX_SWEPT_SPEED_MPS: f64 = 0.0'),
('detector.rs','&& !touched_before',''),
('detector.rs','contact.at_start = true;',''),
]
out=f'{R}/tests/sim/planted'; shutil.rmtree(out,ignore_errors=True); os.makedirs(out)
files=[f for f in os.listdir(f'{R}/src/sim/contact')]
mods=[]
for i,(f,old,new) in enumerate(M):
    for g in files:
        s=src('src/sim/contact/'+g)
        if g==f:
            assert old in s,(f,old); s=s.replace(old,new,1)
        s=s.replace('crate::traffic','wildcity_sim::traffic')
        p=f'{out}/m{i:02}/mutant/{g}'; os.makedirs(os.path.dirname(p),exist_ok=True); open(p,'w').write(s)
    t=src('tests/sim/contact.rs').replace('wildcity_sim::contact','super::mutant')
    open(f'{out}/m{i:02}/tests.rs','w').write(t)
    open(f'{out}/m{i:02}/mod.rs','w').write('pub mod mutant;\nmod tests;\n')
    mods.append(f'mod m{i:02};')
open(f'{out}/mod.rs','w').write('#![allow(warnings)]\n'+'\n'.join(mods)+'\n')
m=src('tests/sim/main.rs')
if 'mod planted' not in m: open(f'{R}/tests/sim/main.rs','w').write(m+'mod planted;\n')
print(len(M))
