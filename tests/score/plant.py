"""Plants one fault into each formula of the score package, as modules of its test binary.

    python3 tests/score/plant.py; cargo test --release -p wildcity-score --test score -- planted; git checkout tests/score/main.rs

Each module mNN has a copy of the package's file with one fault, and a copy of the tests of the vectors that use it. Every
module must have a test that fails; one without is a fault that no vector notices. Nothing of it is committed.
"""
import re,sys,os,shutil
from pathlib import Path

R = Path(__file__).resolve().parents[2]
src=lambda p: open(f'{R}/{p}').read()
def fix(s):
    s=re.sub(r'\b(?:crate|super)::(?:record|savgol|polyline|map|scored)::','wildcity_score::',s)
    s=s.replace('use super::navsim::bounds;','use wildcity_score::navsim::bounds;')
    return s
SC=[ # (source file, test file, old, new)
('alpasim.rs','others.rs','const FULL_PROGRESS: f64 = 0.8','const FULL_PROGRESS: f64 = 0.9'),
('alpasim.rs','others.rs','const SHORT_RECORDING_M: f64 = 5.0','const SHORT_RECORDING_M: f64 = 4.0'),
('alpasim.rs','others.rs','rollout.collision_at_fault || rollout.offroad','rollout.collision_at_fault'),
('alpasim.rs','others.rs','rollout.collision_at_fault || rollout.offroad','rollout.offroad'),
('alpasim.rs','others.rs','rollout.progress.clamp(0.0, 1.0)','rollout.progress'),
('alpasim.rs','others.rs','.min(1.0)\n}','\n}'),
('alpasim.rs','others.rs','sides.last().copied()','sides.first().copied()'),
('alpasim.rs','others.rs','if ego.front_line().touches(other)','if ego.rear_line().touches(other)'),
('alpasim.rs','others.rs','self != Self::Rear','self == Self::Front'),
('alpasim.rs','others.rs','(-decay * k as f64).exp()','(-decay * (k * k) as f64).exp()'),
('neuroncap.rs','others.rs','const FREE: f64 = 5.0','const FREE: f64 = 4.0'),
('neuroncap.rs','others.rs','const TOUCHED: f64 = 4.0','const TOUCHED: f64 = 5.0'),
('neuroncap.rs','others.rs','(1.0 - impact_mps / reference_mps).max(0.0)','(1.0 - impact_mps / reference_mps)'),
('neuroncap.rs','others.rs','(ego_velocity_mps - actor_velocity_mps).length()','ego_velocity_mps.length() - actor_velocity_mps.length()'),
('neuroncap.rs','others.rs','center_x_m: 0.5','center_x_m: 1.5'),
('bench2drive.rs','others.rs','Self::Pedestrian => 0.5','Self::Pedestrian => 0.6'),
('bench2drive.rs','others.rs','Self::Vehicle => 0.6','Self::Vehicle => 0.65'),
('bench2drive.rs','others.rs','Self::Static => 0.65','Self::Static => 0.6'),
('bench2drive.rs','others.rs','(1.0 - outside_percent / 100.0)','1.0'),
('bench2drive.rs','others.rs','infraction == Infraction::MinSpeed','infraction == Infraction::RedLight'),
('bench2drive.rs','others.rs','&& outside_percent == 0.0',''),
('bench2drive.rs','others.rs','const MOST_PERCENT: f64 = 1000.0','const MOST_PERCENT: f64 = 2000.0'),
('bench2drive.rs','others.rs','samples.chunks_exact(SEGMENT)','samples.chunks(SEGMENT)'),
('bench2drive.rs','others.rs','const FILTER: (usize, usize) = (7, 2)','const FILTER: (usize, usize) = (3, 2)'),
('bench2drive.rs','others.rs','least < a && a < most','a < most'),
('hugsim.rs','hugsim.rs','const STATIC_POINTS: usize = 100','const STATIC_POINTS: usize = 99'),
('hugsim.rs','hugsim.rs','from_center.dot(forward).abs() < 0.5','from_center.dot(forward).abs() <= 0.5'),
('hugsim.rs','hugsim.rs','0.0 < above_m','-1.0 < above_m'),
('hugsim.rs','hugsim.rs','share < 0.3','share < 0.2'),
('hugsim.rs','hugsim.rs','(5.0 * self.ttc + 2.0 * self.c) / 7.0','(2.0 * self.ttc + 5.0 * self.c) / 7.0'),
('hugsim.rs','hugsim.rs','[0.5, 1.0].iter().any','[0.5].iter().any'),
('hugsim.rs','hugsim.rs','const SHORT_PLAN_M: f64 = 1.0','const SHORT_PLAN_M: f64 = 0.1'),
('hugsim.rs','hugsim.rs','(least..=most).contains(a)','true || a > &least || a < &most'),
('hugsim.rs','hugsim.rs','(nearest_camera + 1) as f64','nearest_camera as f64'),
('hugsim.rs','hugsim.rs','completions.iter().fold(0.0, |most: f64, &rc| most.max(rc))','completions[completions.len() - 1]'),
('navsim/rules.rs','navsim.rs','const DIRECTION_WINDOW: usize = 11','const DIRECTION_WINDOW: usize = 10'),
('navsim/rules.rs','navsim.rs','[2.0, 6.0]','[2.0, 5.0]'),
('navsim/rules.rs','navsim.rs','const SHORT_REFERENCE_M: f64 = 5.0','const SHORT_REFERENCE_M: f64 = 4.9'),
('navsim/rules.rs','navsim.rs','[0, 3, 6, 9]','[0, 3, 6, 8]'),
('navsim/rules.rs','navsim.rs','if speed_mps < TTC_STANDING_MPS','if speed_mps < -TTC_STANDING_MPS'),
('navsim/rules.rs','navsim.rs','const AHEAD_RAD: f64 = 30.0','const AHEAD_RAD: f64 = 10.0'),
('navsim/rules.rs','navsim.rs','const LANE_KEEPING_M: f64 = 0.5','const LANE_KEEPING_M: f64 = 0.6'),
('navsim/rules.rs','navsim.rs','const LANE_KEEPING_SAMPLES: usize = 20','const LANE_KEEPING_SAMPLES: usize = 19'),
('navsim/rules.rs','navsim.rs','{ 0.0 } else { 0.5 });','{ 0.0 } else { 0.0 });'),
('navsim/rules.rs','navsim.rs','lanes.iter().any(|lanes| lanes.off_drivable)','false'),
('navsim/rules.rs','navsim.rs','let lights = if red { 0.0 } else { 1.0 };','let lights = if red { 1.0 } else { 1.0 };'),
('navsim/rules.rs','navsim.rs','scene.reference_progress_m.max(way_m * gate)','scene.reference_progress_m.max(1e3 * gate)'),
('navsim/rules.rs','navsim.rs','kind.is_at_fault_in(lanes[step])','kind.is_at_fault_in(LanePosition::default())'),
('navsim/rules.rs','navsim.rs','                ignored[k] = true;\n            }\n        }\n    }\n    found','                found.score = 0.25;\n            }\n        }\n    }\n    found'),
('navsim/comfort.rs','navsim.rs','+ center_x_m * rate * rate','- center_x_m * rate * rate'),
('navsim/comfort.rs','navsim.rs','+ center_x_m * ego.yaw_acceleration_radps2',''),
('navsim/comfort.rs','navsim.rs','n.min(8), 2','n.min(7), 2'),
('navsim/comfort.rs','navsim.rs','n.min(15), 2','n.min(9), 2'),
('navsim/comfort.rs','navsim.rs','low < value && value < high','low <= value && value <= high'),
('navsim/comfort.rs','navsim.rs','[-4.05, 2.40]','[-4.05, 3.60]'),
('navsim/comfort.rs','navsim.rs','of_yaw(2, 1)','of_yaw(3, 2)'),
('navsim/comfort.rs','navsim.rs','angle - std::f64::consts::TAU * turns\n','angle\n'),
('navsim/comfort.rs','navsim.rs','[0.7, 0.5, 0.1, 0.1]','[0.9, 0.5, 0.1, 0.1]'),
('navsim/comfort.rs','navsim.rs','(squares / one.len() as f64).sqrt()','squares / one.len() as f64'),
('navsim/mod.rs','navsim.rs','+ 2.0 * agent.ec','+ 2.0 * filtered(agent.ec, human.ec)'),
('navsim/mod.rs','navsim.rs','if human == 0.0 { 1.0 }','if human <= 0.5 { 1.0 }'),
('navsim/mod.rs','navsim.rs','rules * weighted / 16.0','rules * weighted / 17.0'),
('navsim/mod.rs','navsim.rs','* filtered(agent.ddc, human.ddc)',''),
('navsim/mod.rs','navsim.rs','5.0 * filtered(agent.ep, human.ep)','4.0 * filtered(agent.ep, human.ep)'),
('statistics.rs','statistics.rs','1.959_963_984_540_054','1.645'),
('statistics.rs','statistics.rs','(n - 1) as f64).sqrt()','n as f64).sqrt()'),
('statistics.rs','statistics.rs','student_t(n - 1)','student_t(n)'),
]
out=f'{R}/tests/score/planted'; shutil.rmtree(out,ignore_errors=True); os.makedirs(out)
mods=[]
def put(path,text): 
    os.makedirs(os.path.dirname(path),exist_ok=True); open(path,'w').write(text)
for i,(f,t,old,new) in enumerate(SC+[(None,None,None,None)]):
    if f is None: continue
    s=src('src/score/'+f)
    assert old in s,(f,old)
    d=f'{out}/m{i:02}'
    fam=f.split('/')[0].replace('.rs','')
    if fam=='navsim':
        for g in ('mod.rs','rules.rs','comfort.rs'):
            text=src('src/score/navsim/'+g)
            if 'navsim/'+g==f: text=text.replace(old,new,1)
            put(f'{d}/mutant/{g}',fix(text))
    else:
        put(f'{d}/mutant.rs',fix(s.replace(old,new,1)))
    tt=src('tests/score/'+t)
    tt=re.sub(r'\bwildcity_score::'+fam+r'\b','super::mutant',tt)
    tt=tt.replace('use wildcity_score::{EgoSample, neuroncap};','use wildcity_score::EgoSample;\nuse '+('super::mutant as neuroncap;' if fam=='neuroncap' else 'wildcity_score::neuroncap;'))
    tt=tt.replace('use super::mutant::{self, Collision','use super::mutant as alpasim;\nuse super::mutant::{Collision')
    tt=tt.replace('use super::mutant::{self, Infraction','use super::mutant as bench2drive;\nuse super::mutant::{Infraction')
    tt=tt.replace('use super::mutant::{\n    self, Rules','use super::mutant as navsim;\nuse super::mutant::{\n    Rules')
    tt=tt.replace('use crate::vectors','use crate::vectors')
    put(f'{d}/tests.rs',tt)
    put(f'{d}/mod.rs','pub mod mutant;\nmod tests;\n')
    mods.append(f'mod m{i:02};')
put(f'{out}/mod.rs','#![allow(warnings)]\n'+'\n'.join(mods)+'\n')
m=src('tests/score/main.rs')
if 'mod planted' not in m: open(f'{R}/tests/score/main.rs','w').write(m+'mod planted;\n')
print(len(SC))
