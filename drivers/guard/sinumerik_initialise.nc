PROC TP{program}(REAL _A) DISPLOF
;TOOLPOINT INITIALISE
;IN MDA, COMPENSATION OFF, SD43900 AS THE OPERATOR WANTS IT
;TP{program} FIRST TIME. TP{program}(1) FORGETS WHAT IS APPLIED
STOPRE
IF R{enable}=={vacant} GOTOF TP_OFF
IF R{enable}<>0 GOTOF TP_ENABLED
TP_OFF:
IF NOT $P_SUBPAR[1] GOTOF TP_LOOK
IF _A<>1 GOTOF TP_WRONG
GOTOF TP_CLEAR
TP_LOOK:
IF (R{pending}<>{vacant}) AND (R{pending}<>0) GOTOF TP_APPLIED
@axes
IF (R{echo}<>{vacant}) AND (R{echo}<>0) GOTOF TP_APPLIED
IF (R{mirror}<>{vacant}) AND (R{mirror}<>0) GOTOF TP_APPLIED
@end
TP_CLEAR:
R{pending}=0
R{planned}=0
R{before}=0
R{after}=0
@axes
R{mirror}=0
R{echo}=0
@end
@request
R{kind}=0
R{axis}=0
R{value_mm}=0
IF R{counter}=={vacant}
R{counter}=0
ENDIF
@end
TP{start}
@flag
R{safe_flag}=0
@end
STOPRE
R{echo_time}=$AC_TIMER[{timer}]
R{echo_status}=0
R{echo_guard_version}={version}
M17
TP_ENABLED:
{alarm110}
M17
TP_APPLIED:
{alarm111}
M17
TP_WRONG:
{alarm112}
M17
