PROC TP{program} SAVE DISPLOF
;TOOLPOINT GUARD V{version}
;CALL TP{program} AT SAFE POINTS ONLY, TOOL CLEAR OF THE WORK
;NEVER IN A CUT. METRIC, G40. ONE CALL MOVES AT MOST ONE STEP
;DOES NOTHING IN A BLOCK SEARCH, A PROGRAM TEST, A SIMULATION
DEF REAL _SB,_SA,_UNTIL,_CLOCK,_ON,_CHK,_SUM,_OLD,_NEW
DEF INT _STAT=0,_MEM=0,_TRY=0,_BITS=0
@axes
DEF REAL _V{number}
@end
IF $P_SEARCH OR $P_SIM OR $P_ISTEST GOTOF TP_END
STOPRE
TP{start}
;READ THE BLOCK, LAST WORD FIRST. TRY AGAIN WHILE IT IS BEING WRITTEN
TP_READ:
STOPRE
_SB=R{sequence_b}
@axes
_V{number}=R{value}
@end
_UNTIL=R{valid_until}
_ON=R{enable}
@check
_CHK=R{check}
@end
_SA=R{sequence_a}
IF _SB==_SA GOTOF TP_SETTLE
_TRY=_TRY+1
IF _TRY>{tries} GOTOF TP_SETTLE
G4 F{retry_s}
STOPRE
GOTOB TP_READ
TP_SETTLE:
_CLOCK=$AC_TIMER[{timer}]
;SETTLE WHAT A RESET INTERRUPTED. SD43900 IN MM ONLY
IF NOT $MN_SCALING_SYSTEM_IS_METRIC GOTOF TP_JUDGE
IF ($P_GG[13]<>2) AND ($P_GG[13]<>4) GOTOF TP_JUDGE
IF R{pending}==0 GOTOF TP_WHOLE
@axes
IF R{pending}=={number} GOTOF TP_S{number}
@end
GOTOF TP_BAD
@axes
TP_S{number}:
_NEW=R{planned}
;DONE
IF ABS({datum}[{letter}]{of_datum}-R{after})<{half} GOTOF TP_T{number}
_NEW=R{planned}-(R{after}-R{before})
;NOT DONE
IF ABS({datum}[{letter}]{of_datum}-R{before})<{half} GOTOF TP_T{number}
_MEM=9
GOTOF TP_JUDGE
TP_T{number}:
R{echo}=_NEW{per_unit}
R{mirror}=_NEW
R{pending}=0
GOTOF TP_WHOLE
@end
;IS THE MEMORY WHOLE
TP_WHOLE:
@axes
IF R{echo}=={vacant} GOTOF TP_BAD
IF R{mirror}=={vacant} GOTOF TP_BAD
IF ABS(R{echo}{to_mm}-R{mirror})>{half} GOTOF TP_BAD
IF ABS(R{mirror})>{bound_slack} GOTOF TP_BAD
@end
GOTOF TP_JUDGE
TP_BAD:
_MEM=8
;JUDGE THE BLOCK
TP_JUDGE:
IF _SB=={vacant} GOTOF TP_TORN
IF _SA=={vacant} GOTOF TP_TORN
IF _SB==_SA GOTOF TP_SAME
;TORN. IF LEFT SO BY A DEAD WRITER IT EXPIRES TOO
TP_TORN:
_STAT=2
IF _ON=={vacant} GOTOF TP_ECHO
IF _ON==0 GOTOF TP_ECHO
IF _UNTIL==0 GOTOF TP_ECHO
IF _UNTIL=={vacant} GOTOF TP_LIMITS
IF _UNTIL>_CLOCK+{look_ahead} GOTOF TP_LIMITS
IF _UNTIL>_CLOCK GOTOF TP_ECHO
GOTOF TP_LIMITS
TP_SAME:
IF _ON=={vacant} GOTOF TP_F4
IF _ON==0 GOTOF TP_F1
TP_LIMITS:
IF _ON<0 GOTOF TP_F5
IF _ON>{all_bits} GOTOF TP_F5
IF TRUNC(_ON)<>_ON GOTOF TP_F5
_BITS=TRUNC(_ON)
IF NOT $MN_SCALING_SYSTEM_IS_METRIC GOTOF TP_F6
IF ($P_GG[13]<>2) AND ($P_GG[13]<>4) GOTOF TP_F6
IF $P_GG[7]<>1 GOTOF TP_F7
IF _MEM<>0 GOTOF TP_FM
@axes
IF ($MA_TEMP_COMP_TYPE[{letter}] B_AND {type_bit})==0 GOTOF TP_F11
IF $MA_COMP_ADD_VELO_FACTOR[{letter}]<=0 GOTOF TP_F11
@end
@slopes
IF ABS($SA_TEMP_COMP_REF_POSITION[{letter}]-({pivot}))>{half} GOTOF TP_F11
@end
IF _STAT==2 GOTOF TP_EXPIRED
IF _UNTIL=={vacant} GOTOF TP_EXPIRED
IF _UNTIL<=_CLOCK GOTOF TP_EXPIRED
IF _UNTIL>_CLOCK+{look_ahead} GOTOF TP_EXPIRED
@axes
IF (_BITS B_AND {bit})==0 GOTOF TP_D{number}
IF _V{number}=={vacant} GOTOF TP_F4
IF ABS(_V{number}{to_mm})>{bound_tolerance} GOTOF TP_F5
GOTOF TP_J{number}
;VACANT COUNTS AS 0 IN THE CHECK
TP_D{number}:
IF _V{number}=={vacant}
_V{number}=0
ENDIF
TP_J{number}:
@end
@check
;THE CHECK, WHOLE NUMBERS ONLY. IT FITS OR NOTHING IS APPLIED
_SUM=_SB+_ON+ROUND(_UNTIL*{per_second})
@end
@check_axes
IF ABS(_V{number}{to_mm})>{bound_tolerance} GOTOF TP_F10
_SUM=_SUM+({number}*ROUND(_V{number}{to_mm}*{nm_per_mm})){pivot_check}
@end
@check
IF _CHK<>_SUM GOTOF TP_F10
@end
GOTOF TP_APPLY
;EXPIRED. A BLOCK THAT HAS EXPIRED ONCE NEVER COUNTS AGAIN
TP_EXPIRED:
_STAT=3
IF R{valid_until}==_UNTIL
R{valid_until}={vacant}
ENDIF
@keep
;POLICY KEEP
GOTOF TP_ECHO
@end
@zero
;POLICY ZERO, STEP BY STEP. EVERY AXIS, BITS MAY BE FOREIGN
_BITS={all_bits}
@end
@zero_axes
_V{number}=0
@end
;APPLY THE DIFFERENCE, AXIS BY AXIS, EACH WRITTEN AHEAD
TP_APPLY:
R{echo_status}={unfinished}
@axes
IF (_BITS B_AND {bit})==0 GOTOF TP_A{number}
_OLD=R{mirror}
_NEW=ROUND(_V{number}{to_mm}/{increment})*{increment}
IF _NEW>{bound}
_NEW={bound}
ENDIF
IF _NEW<-{bound}
_NEW=-{bound}
ENDIF
_NEW=_NEW-_OLD
IF _NEW>{step}
_NEW={step}
ENDIF
IF _NEW<-{step}
_NEW=-{step}
ENDIF
IF ABS(_NEW)<{half} GOTOF TP_A{number}
R{planned}=ROUND((_OLD+_NEW)/{increment})*{increment}
_NEW=R{planned}-_OLD
R{before}={datum}[{letter}]{of_datum}
R{after}=R{before}+_NEW
R{pending}={number}
STOPRE
{datum}[{letter}]={datum}[{letter}]+_NEW{per_datum}
STOPRE
IF ABS({datum}[{letter}]{of_datum}-R{after})>{half} GOTOF TP_F9
R{echo}=R{planned}{per_unit}
R{mirror}=R{planned}
R{pending}=0
TP_A{number}:
@end
GOTOF TP_ECHO
TP_F1:
_STAT=1
GOTOF TP_ECHO
TP_F4:
_STAT=4
GOTOF TP_ECHO
TP_F5:
_STAT=5
GOTOF TP_ECHO
TP_F6:
_STAT=6
GOTOF TP_ECHO
TP_F7:
_STAT=7
GOTOF TP_ECHO
TP_FM:
_STAT=_MEM
GOTOF TP_ECHO
TP_F9:
_STAT=9
GOTOF TP_ECHO
@check
TP_F10:
_STAT=10
GOTOF TP_ECHO
@end
TP_F11:
_STAT=11
TP_ECHO:
STOPRE
R{echo_time}=_CLOCK
R{echo_status}=_STAT
R{echo_guard_version}={version}
IF _STAT<3 GOTOF TP_END
IF _STAT==3
{alarm3}
ENDIF
IF _STAT==4
{alarm4}
ENDIF
IF _STAT==5
{alarm5}
ENDIF
IF _STAT==6
{alarm6}
ENDIF
IF _STAT==7
{alarm7}
ENDIF
IF _STAT==8
{alarm8}
ENDIF
IF _STAT==9
{alarm9}
ENDIF
@check
IF _STAT==10
{alarm10}
ENDIF
@end
IF _STAT==11
{alarm11}
ENDIF
TP_END:
M17
