O{program}(TOOLPOINT INITIALISE)
(IN MDI, COMPENSATION OFF, EXTERNAL OFFSET AS THE OPERATOR WANTS IT)
(G65P{program} FIRST TIME. G65P{program}A1. FORGETS WHAT IS APPLIED)
{stop}
IF[#{enable}EQ#0]GOTO90010
IF[#{enable}NE0]GOTO90080
N90010
IF[#1EQ#0]GOTO90015
IF[#1NE1]GOTO90082
GOTO90020
N90015
IF[ABS[#{pending}]GT0]GOTO90081
@axes
IF[ABS[#{echo}]GT0]GOTO90081
IF[ABS[#{mirror}]GT0]GOTO90081
@end
N90020#{pending}=0
#{planned}=0
#{before}=0
#{after}=0
@axes
#{mirror}=0
#{echo}=0
@end
@slopes
#{place}=0
@end
@placed
#{planned_place}=0
@end
@request
#{kind}=0
#{axis}=0
#{value_mm}=0
IF[#{counter}EQ#0]THEN#{counter}=0
@end
@flag
#{safe_flag}=0
@end
#{echo_time}=#3001/1000
#{echo_status}=0
#{echo_guard_version}={version}
M99
N90080#3000=110(TOOLPOINT SWITCH OFF FIRST)
N90081#3000=111(TOOLPOINT OFFSET APPLIED)
N90082#3000=112(TOOLPOINT A IS NOT 1)
M99
