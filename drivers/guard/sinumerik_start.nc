PROC TP{program} DISPLOF
;TOOLPOINT START V{version}
;CALL TP{program} AT THE HEAD OF PROGRAMS AND AFTER POWER-ON
STOPRE
IF $AC_TIMER[{timer}]>0 GOTOF TP_ON
;SWITCHED ON SINCE: THE TIMER STANDS AT 0. R PARAMETERS SURVIVE, NO BLOCK MAY
R{valid_until}={vacant}{cleared}
@flag
R{safe_flag}={vacant}
@end
IF R{power_on_count}<0
R{power_on_count}=0
ENDIF
R{power_on_count}=R{power_on_count}+1
R{clock}=0
$AC_TIMER[{timer}]=0.001
STOPRE
TP_ON:
IDS={action} DO $R{clock}=$AC_TIMER[{timer}]
M17
