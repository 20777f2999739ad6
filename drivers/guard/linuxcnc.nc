o<toolpoint> sub
(TOOLPOINT GUARD V{version} FOR LINUXCNC, FILE toolpoint.ngc IN [RS274NGC]SUBROUTINE_PATH)
(o<toolpoint> call [1] AT SAFE POINTS ONLY, TOOL CLEAR OF THE WORK, G8 G21 G40 G80 G54)
@request
(o<toolpoint> call [2] [1] [0] REFERENCE, [2] [1] [AXIS] TOOL SETTING)
(o<toolpoint> call [2] [2] [AXIS] [MM] PROBE, [2] [3] [0] [TOOL] TOOL CHANGE)
@end
@flag
(o<toolpoint> call [3] SAFE POINT BEGINS, [4] SAFE POINT ENDS)
@end
(o<toolpoint> call [5] [0] INITIALISES, [5] [1] FORGETS WHAT IS APPLIED)
(LIST #{first} TO #{last} IN THE PARAMETER FILE, OR THEY ARE LOST WITH EVERY START)
o3 if [#<_task> EQ 0]
(A PREVIEW RUNS THIS TOO, AND WOULD WAIT FOR EVER)
o<toolpoint> return [0]
o3 endif
#<what>=#1
#<known>=[[#<what> EQ 1] OR [#<what> EQ 5]]
@request
#<known>=[#<known> OR [#<what> EQ 2]]
@end
@flag
#<known>=[#<known> OR [#<what> EQ 3] OR [#<what> EQ 4]]
@end
o7 if [#<known> EQ 0]
(ABORT, TOOLPOINT CALL WRONG)
o7 endif
#<status>=0
#<trouble>=0
#<tries>=0
(A RUN FROM LINE PASSES THIS AND MOVES NOTHING: THE AXES ARE NOT WHERE THE PROGRAM HAS TAKEN THEM)
#<x>=#5420
#<y>=#5421
#<z>=#5422
M66 E{clock} L0
#<now>=#5399
#<passed>=[[#<_ccomp> EQ 400] AND [ABS[#<x>-#5420]+ABS[#<y>-#5421]+ABS[#<z>-#5422] GT 0.001]]
o5 if [EXISTS[#<_toolpoint_passed>]]
(ANOTHER CALL BEHIND IT, BEFORE THE PROGRAM HAS GONE ON)
o6 if [ABS[#<now>-#<_toolpoint_passed>] LT 0.5]
#<passed>=1
o6 endif
o5 endif
@flag
o2 if [#<what> EQ 4]
M68 E{safe_flag} Q0
M66 E{clock} L0
o<toolpoint> return [0]
o2 endif
@end
o4 if [#<passed>]
#<_toolpoint_passed>=#<now>
(MSG, TOOLPOINT PASSED IN RUN FROM LINE)
M66 E{clock} L0
o<toolpoint> return [0]
o4 endif
@flag
o1 if [#<what> EQ 3]
M68 E{safe_flag} Q1
#<what>=1
o1 endif
@end
(READ THE BLOCK, LAST WORD FIRST. M66 ENDS THE READING AHEAD. AGAIN WHILE IT IS BEING WRITTEN)
o10 do
M66 E{sequence_b} L0
#<b>=#5399
@axes
M66 E{value} L0
#<v{number}>=#5399
@end
M66 E{valid_until} L0
#<until>=#5399
M66 E{enable} L0
#<enable>=#5399
M66 E{check} L0
#<check>=#5399
M66 E{sequence_a} L0
#<a>=#5399
#<tries>=[#<tries>+1]
o11 if [[ABS[#<a>-#<b>] GT 0.5] AND [#<tries> LE {tries}]]
G4 P{retry_s}
o11 endif
o10 while [[ABS[#<a>-#<b>] GT 0.5] AND [#<tries> LE {tries}]]
M66 E{clock} L0
#<now>=#5399
o20 if [#<what> EQ 5]
o21 if [#<enable> GT 0]
(ABORT, TOOLPOINT SWITCH OFF FIRST)
o21 endif
o22 if [[#2 NE 1] AND [#{magic} EQ {magic_value}]]
o24 if [#{pending} NE 0]
(ABORT, TOOLPOINT OFFSET APPLIED)
o24 endif
@axes
o23{number} if [ABS[#{mirror}] GE {half}]
(ABORT, TOOLPOINT OFFSET APPLIED)
o23{number} endif
@end
o22 endif
#{pending}=0
#{planned}=0
#{before}=0
#{after}=0
@axes
#{mirror}=0
@end
@slopes
#{place}=0
@end
@placed
#{planned_place}=0
@end
#{magic}={magic_value}
o20 endif
(SETTLE WHAT AN ABORT INTERRUPTED. IS THE MEMORY WHOLE)
o30 if [#{magic} NE {magic_value}]
#<trouble>=8
o30 elseif [#<_metric> EQ 1]
@axes
o31{number} if [#{pending} EQ {number}]
o32{number} if [ABS[#{offset}-#{after}] LT {half}]
#{mirror}=#{planned}{keep_place}
#{pending}=0
o32{number} elseif [ABS[#{offset}-#{before}] LT {half}]
#{pending}=0
o32{number} else
#<trouble>=9
o32{number} endif
o31{number} endif
o33{number} if [ABS[#{mirror}] GT {bound_slack}]
#<trouble>=8
o33{number} endif
@end
@slopes
o34{number} if [ABS[#{place}] GT {reach_slack}]
#<trouble>=8
o34{number} endif
@end
o30 endif
(JUDGE THE BLOCK)
#<old>=[[#<until> LE #<now>] OR [#<until> GT #<now>+{look_ahead}]]
#<torn>=[[ABS[#<a>-#<b>] GT 0.5] OR [#<a> LT {vacant}]]
(TORN. IF LEFT SO BY A DEAD WRITER IT EXPIRES TOO)
o40 if [#<torn> AND [[#<enable> LT {vacant}] OR [#<enable> EQ 0] OR [#<until> EQ 0] OR [#<old> EQ 0]]]
#<status>=2
o40 elseif [#<enable> EQ 0]
#<status>=1
o40 elseif [#<enable> LT {vacant}]
#<status>=4
o40 elseif [[#<enable> LT 0] OR [#<enable> GT {all_bits}] OR [FIX[#<enable>] NE #<enable>]]
#<status>=5
o40 elseif [#<_metric> NE 1]
#<status>=6
o40 elseif [[#<_ccomp> NE 400] OR [[#<_motion_mode> GE 810] AND [#<_motion_mode> LE 890]] OR [#<_coord_system> NE 540] OR [#<_lathe_diameter_mode> EQ 1]]
#<status>=7
o40 elseif [#<trouble> NE 0]
#<status>=#<trouble>
o40 elseif [#<old>]
#<status>=3
o40 else
#<sum>=[#<b>+#<enable>+ROUND[#<until>*{per_second}]]
@axes
o42{number} if [#<v{number}> LT {vacant}]
o43{number} if [[FIX[#<enable>/{bit}] MOD 2] EQ 1]
#<status>=4
o43{number} endif
#<v{number}>=0
o42{number} endif
o44{number} if [[[FIX[#<enable>/{bit}] MOD 2] EQ 1] AND [ABS[#<v{number}>{to_mm}] GT {bound_tolerance}]]
#<status>=5
o44{number} endif
#<sum>=[#<sum>+{number}*ROUND[#<v{number}>{to_mm}*{nm_per_mm}]{pivot_check}]
@end
o45 if [[#<status> EQ 0] AND [ABS[#<check>-#<sum>] GT 0.5]]
#<status>=10
o45 endif
@slopes
(A SLOPE COUNTS FOR WHERE THE AXIS STANDS, WHICH MUST BE IN ITS TRAVEL)
#<outside>=[[{position} LT {lowest}] OR [{position} GT {highest}]]
o46{number} if [[#<status> EQ 0] AND [[FIX[#<enable>/{bit}] MOD 2] EQ 1] AND [#<outside>]]
#<status>=12
o46{number} endif
@end
o40 endif
@zero
(POLICY ZERO, STEP BY STEP. EVERY AXIS, BITS MAY BE FOREIGN)
o50 if [#<status> EQ 3]
#<enable>={all_bits}
@end
@zero_axes
#<v{number}>=0
@end
@zero
o50 endif
@end
(APPLY THE DIFFERENCE, AXIS BY AXIS, EACH WRITTEN AHEAD)
o60 if [[#<what> EQ 1] AND [[#<status> EQ 0] OR [[#<status> EQ 3] AND [{zero}]]]]
M68 E{echo_status} Q{unfinished}
M66 E{clock} L0
@offsets
o61{number} if [[[FIX[#<enable>/{bit}] MOD 2] EQ 1] AND [#<status> NE 9]]
#<d>=[ROUND[#<v{number}>{to_mm}/{increment}]*{increment}]
o62{number} if [#<d> GT {bound}]
#<d>={bound}
o62{number} endif
o63{number} if [#<d> LT -{bound}]
#<d>=-{bound}
o63{number} endif
#<d>=[#<d>-#{mirror}]
o64{number} if [#<d> GT {step}]
#<d>={step}
o64{number} endif
o65{number} if [#<d> LT -{step}]
#<d>=-{step}
o65{number} endif
o66{number} if [ABS[#<d>] GE {half}]
#{planned}=[ROUND[[#{mirror}+#<d>]/{increment}]*{increment}]
#{before}=#{offset}
#{after}=[#{offset}+#{planned}-#{mirror}]
#{pending}={number}
G10 L2 P1 {letter}[#{after}]
o67{number} if [ABS[#{offset}-#{after}] LT {half}]
#{mirror}=#{planned}
#{pending}=0
o67{number} else
#<status>=9
o67{number} endif
o66{number} endif
o61{number} endif
@end
@slopes
o61{number} if [[[FIX[#<enable>/{bit}] MOD 2] EQ 1] AND [#<status> NE 9]]
#<to>=[{position}-[{pivot}]]
o62{number} if [#<status> EQ 3]
#<to>=#{place}
o62{number} endif
(MM OF THE SLOPE AT ITS PLACE)
#<was>=[ROUND[#{mirror}*#{place}/1000/{increment}]*{increment}]
#<was>=[[ABS[#<was>+{most}]-ABS[#<was>-{most}]]/2]
#<d>=[ROUND[#<v{number}>{to_mm}/{increment}]*{increment}]
#<d>=[[ABS[#<d>+{bound}]-ABS[#<d>-{bound}]]/2-#{mirror}]
#<d>=[[ABS[#<d>+{step}]-ABS[#<d>-{step}]]/2]
#<new>=[ROUND[[#{mirror}+#<d>]/{increment}]*{increment}]
(WHAT IS LEFT OF THE STEP GOES TOWARDS THE PLACE)
#<left>=[{place_step}-ABS[[#<new>-#{mirror}]*#{place}/1000]]
o63{number} if [#<left> LT 0]
#<left>=0
o63{number} endif
#<way>=[#<to>-#{place}]
o64{number} if [ABS[#<new>*#<way>/1000] GT #<left>]
#<way>=[#<way>*#<left>/ABS[#<new>*#<way>/1000]]
#<status>=13
o64{number} endif
o66{number} if [ABS[#<new>-#{mirror}]+ABS[#<way>] GE {half}]
#{planned}=#<new>
#{planned_place}=[ROUND[[#{place}+#<way>]*1000]/1000]
#<d>=[ROUND[#<new>*#{planned_place}/1000/{increment}]*{increment}]
#<d>=[[ABS[#<d>+{most}]-ABS[#<d>-{most}]]/2-#<was>]
#{before}=#{offset}
#{after}=[#{offset}+#<d>]
#{pending}={number}
G10 L2 P1 {letter}[#{after}]
o67{number} if [ABS[#{offset}-#{after}] LT {half}]
#{mirror}=#{planned}
#{place}=#{planned_place}
#{pending}=0
o67{number} else
#<status>=9
o67{number} endif
o66{number} endif
o61{number} endif
@end
o60 endif
(ECHO)
o70 if [#{magic} EQ {magic_value}]
@axes
M68 E{echo} Q[#{mirror}{per_unit}]
@end
M68 E{echo_guard_version} Q{version}
o71 if [#<what> NE 2]
M68 E{echo_status} Q[#<status>]
M68 E{echo_time} Q[#<now>]
o71 endif
o70 endif
(THE ECHO IS OUT BEFORE THIS ENDS: A RUN FROM LINE THROWS AWAY WHAT STILL WAITS THEN)
M66 E{clock} L0
@slopes
#<far>=[ABS[#{mirror}*[{position}-[{pivot}]-#{place}]]]
o89{number} if [[#<what> EQ 2] AND [#2 LT 3] AND [#<_metric> EQ 1] AND [#<far> GT 1]]
(ABORT, TOOLPOINT CALL GUARD HERE)
o89{number} endif
@end
@request
o80 if [#<what> EQ 2]
o81 if [[#2 LT 1] OR [#2 GT 3] OR [FIX[#2] NE #2] OR [#3 LT 0] OR [#3 GT {axis_count}] OR [FIX[#3] NE #3]]
(ABORT, TOOLPOINT REQUEST WRONG)
o81 endif
(LINUXCNC TAKES A NUMBER THAT IS MISSING FOR 0: NO PROBE MEASURES THAT, AND T0 IS AN EMPTY SPINDLE)
#<missing>=[[#2 EQ 2] AND [ABS[#4] LT 0.000001]]
o88 if [[#2 EQ 3] AND [#4 EQ 0] AND [#<_current_tool> GT 0]]
#<missing>=1
o88 endif
o82 if [#<missing> OR [[#2 EQ 2] AND [#3 LT 1]] OR [[#2 EQ 3] AND [[#4 LT 0] OR [FIX[#4] NE #4]]]]
(ABORT, TOOLPOINT REQUEST WRONG)
o82 endif
o83 if [#<_metric> NE 1]
(ABORT, TOOLPOINT REQUEST IN INCH)
o83 endif
#{counted}=[[#{counted} MOD 999998]+1]
M66 E{acknowledge} L0
o84 if [ABS[#5399] EQ #{counted}]
#{counted}=[#{counted}+1]
o84 endif
M68 E{kind} Q[#2]
M68 E{axis} Q[#3]
M68 E{value_mm} Q[#4]
M68 E{counter} Q[#{counted}]
#<begun>=#<now>
o85 do
G4 P0.05
M66 E{clock} L0
#<now>=#5399
M66 E{acknowledge} L0
#<ack>=#5399
o85 while [[ABS[#<ack>] NE #{counted}] AND [#<now>-#<begun> LT {timeout_s}]]
o86 if [ABS[#<ack>] NE #{counted}]
M68 E{kind} Q0
M66 E{clock} L0
{timed_out}
o86 elseif [#<ack> LT 0]
{refused}
o86 endif
o80 endif
@end
o90 if [#<what> EQ 1]
{alarms}
o90 endif
o<toolpoint> endsub [#<status>]
M2
