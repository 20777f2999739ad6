O{program}(TOOLPOINT GUARD V{version})
(CALL G65P{program} AT SAFE POINTS ONLY, TOOL CLEAR OF THE WORK)
(NEVER IN A CUT. METRIC, G40, G80. ONE CALL MOVES AT MOST ONE STEP)
#5=#4003(G90 OR G91, FOR LATER)
G90
{stop}(END READING AHEAD, G90 BECAUSE G91 MAY IGNORE G53)
#7=0(STATUS)
#8=0(TROUBLE WITH THE MEMORY)
#10=0(TRIES)
(READ THE BLOCK, LAST WORD FIRST. TRY AGAIN WHILE IT IS BEING WRITTEN)
N90010
#1=#{sequence_b}
@axes
#{local}=#{value}(VALUE {letter})
@end
#3=#{valid_until}(VALID UNTIL)
#4=#{enable}(ENABLE BITS)
@check
#22=#{check}
@end
#2=#{sequence_a}
IF[#1EQ#2]GOTO90020
#10=#10+1
IF[#10GT{tries}]GOTO90020
G04P{retry_ms}
{stop}
GOTO90010
N90020
#6=#3001/1000(CLOCK, S)
(SETTLE WHAT A RESET INTERRUPTED)
IF[#4006NE21]GOTO90300
IF[#{pending}EQ0]GOTO90200
@axes
IF[#{pending}EQ{number}]GOTO{settle}
@end
GOTO90290
@offsets
N{settle}#21=#{planned}(DONE)
IF[ABS[#{offset}-#{after}]LT{half}]GOTO{settled}
#21=#{planned}-#{after}+#{before}(NOT DONE)
IF[ABS[#{offset}-#{before}]LT{half}]GOTO{settled}
#8=9
GOTO90300
N{settled}#{echo}=#21{per_unit}
#{mirror}=#21
#{pending}=0
GOTO90200
@end
@slopes
N{settle}
IF[ABS[#{offset}-#{after}]LT{half}]GOTO{settled}
IF[ABS[#{offset}-#{before}]LT{half}]GOTO{undone}
#8=9
GOTO90300
N{settled}#{mirror}=#{planned}(DONE)
#{place}=#{planned_place}
N{undone}#{echo}=#{mirror}{per_unit}
#{pending}=0
GOTO90200
@end
(IS THE MEMORY WHOLE)
N90200
@axes
IF[#{echo}EQ#0]GOTO90290
IF[#{mirror}EQ#0]GOTO90290
IF[ABS[#{echo}{to_mm}-#{mirror}]GT{half}]GOTO90290
IF[ABS[#{mirror}]GT{bound_slack}]GOTO90290
@end
@slopes
IF[#{place}EQ#0]GOTO90290
IF[ABS[#{place}]GT{reach_slack}]GOTO90290
@end
GOTO90300
N90290#8=8
(JUDGE THE BLOCK)
N90300
IF[#1EQ#0]GOTO90310
IF[#2EQ#0]GOTO90310
IF[#1EQ#2]GOTO90320
N90310#7=2(TORN. IF LEFT SO BY A DEAD WRITER IT EXPIRES TOO)
IF[#4EQ#0]GOTO90800
IF[#4EQ0]GOTO90800
IF[#3EQ0]GOTO90800
IF[#3EQ#0]GOTO90330
IF[#3GT#6+{look_ahead}]GOTO90330
IF[#3GT#6]GOTO90800
GOTO90330
N90320
IF[#4EQ#0]GOTO90540
IF[#4EQ0]GOTO90510
N90330
IF[#4LT0]GOTO90550
IF[#4GT{all_bits}]GOTO90550
IF[FIX[#4]NE#4]GOTO90550
IF[#4006NE21]GOTO90560
IF[#4007NE40]GOTO90570
IF[#4009NE80]GOTO90570
IF[#8NE0]GOTO90580
IF[#7EQ2]GOTO90400
IF[#3EQ#0]GOTO90400
IF[#3LE#6]GOTO90400
IF[#3GT#6+{look_ahead}]GOTO90400
@axes
IF[[FIX[#4/{bit}]AND1]EQ0]GOTO{judged}
IF[#{local}EQ#0]GOTO90540
IF[ABS[#{local}{to_mm}]GT{bound_tolerance}]GOTO90550
N{judged}
@end
@check
(THE CHECK, WHOLE NUMBERS ONLY. IT FITS OR NOTHING IS APPLIED)
#23=#1+#4+ROUND[#3*{per_second}]
@end
@check_axes
#23=#23+{number}*ROUND[#{local}{to_mm}*{nm_per_mm}]{pivot_check}
@end
@check
IF[#22NE#23]GOTO90595
@end
@slopes
(A SLOPE COUNTS FOR WHERE THE AXIS STANDS, WHICH MUST BE IN ITS TRAVEL)
IF[[FIX[#4/{bit}]AND1]EQ0]GOTO{placed}
#24=#{position}
IF[#24EQ#0]GOTO90592
IF[#24LT{lowest}]GOTO90592
IF[#24GT{highest}]GOTO90592
N{placed}
@end
GOTO90600
(EXPIRED. A BLOCK THAT HAS EXPIRED ONCE NEVER COUNTS AGAIN)
N90400#7=3
IF[#{valid_until}EQ#3]THEN#{valid_until}=#0
@keep
GOTO90800(POLICY KEEP)
@end
@zero
(POLICY ZERO, STEP BY STEP. EVERY AXIS, BITS MAY BE FOREIGN)
#4={all_bits}
@end
@zero_axes
#{local}=0
@end
(APPLY THE DIFFERENCE, AXIS BY AXIS, EACH WRITTEN AHEAD)
N90600#{echo_status}={unfinished}(UNTIL IT HAS ENDED)
@offsets
IF[[FIX[#4/{bit}]AND1]EQ0]GOTO{applied}
#20=#{mirror}(APPLIED)
#21=ROUND[#{local}{to_mm}/{increment}]*{increment}
IF[#21GT{bound}]THEN#21={bound}
IF[#21LT-{bound}]THEN#21=-{bound}
#21=#21-#20
IF[#21GT{step}]THEN#21={step}
IF[#21LT-{step}]THEN#21=-{step}
IF[ABS[#21]LT{half}]GOTO{applied}
#{planned}=ROUND[[#20+#21]/{increment}]*{increment}
#21=#{planned}-#20
#{before}=#{offset}
#{after}=#{before}+#21
#{pending}={number}
G90G10L2P0{letter}[#{offset}+#21]
{stop}
IF[ABS[#{offset}-#{after}]GT{half}]GOTO90590
#{echo}=#{planned}{per_unit}
#{mirror}=#{planned}
#{pending}=0
N{applied}
@end
@slopes
IF[[FIX[#4/{bit}]AND1]EQ0]GOTO{applied}
#20=#{mirror}(APPLIED, MM PER M)
#24=#{position}-[{pivot}](PLACE)
IF[#7EQ3]THEN#24=#{place}
#25=ROUND[#20*#{place}/1000./{increment}]*{increment}(ITS MM)
IF[#25GT{most}]THEN#25={most}
IF[#25LT-{most}]THEN#25=-{most}
#21=ROUND[#{local}{to_mm}/{increment}]*{increment}
IF[#21GT{bound}]THEN#21={bound}
IF[#21LT-{bound}]THEN#21=-{bound}
#21=#21-#20
IF[#21GT{step}]THEN#21={step}
IF[#21LT-{step}]THEN#21=-{step}
#26=ROUND[[#20+#21]/{increment}]*{increment}
(WHAT IS LEFT OF THE STEP GOES TOWARDS THE PLACE)
#27={place_step}-ABS[[#26-#20]*#{place}/1000.]
IF[#27LT0]THEN#27=0
#28=#24-#{place}
#29=ABS[#26*#28/1000.]
IF[#29LE#27]GOTO{there}
#28=#28*#27/#29
#7=13
N{there}
#28=#{place}+#28
#21=ABS[#26-#20]+ABS[#28-#{place}]
IF[#21LT{half}]GOTO{applied}
#{planned}=#26
#{planned_place}=#28
#21=ROUND[#26*#28/1000./{increment}]*{increment}
IF[#21GT{most}]THEN#21={most}
IF[#21LT-{most}]THEN#21=-{most}
#21=#21-#25
#{before}=#{offset}
#{after}=#{before}+#21
#{pending}={number}
G90G10L2P0{letter}[#{offset}+#21]
{stop}
IF[ABS[#{offset}-#{after}]GT{half}]GOTO90590
#{echo}=#{planned}{per_unit}
#{mirror}=#{planned}
#{place}=#{planned_place}
#{pending}=0
N{applied}
@end
GOTO90800
N90510#7=1
GOTO90800
N90540#7=4
GOTO90800
N90550#7=5
GOTO90800
N90560#7=6
GOTO90800
N90570#7=7
GOTO90800
N90580#7=#8
GOTO90800
N90590#7=9
@placed
GOTO90800
N90592#7=12
@end
@check
GOTO90800
N90595#7=10
@end
(ECHO)
N90800
#{echo_time}=#6
#{echo_status}=#7
#{echo_guard_version}={version}
G#5
IF[#7LT3]GOTO90900
#9=#7+90900
GOTO#9
N90903{alarm3}(TOOLPOINT EXPIRED)
GOTO90900
N90904{alarm4}(TOOLPOINT VACANT MACRO)
GOTO90900
N90905{alarm5}(TOOLPOINT OVERSIZE VALUE)
GOTO90900
N90906{alarm6}(TOOLPOINT INCH MODE)
GOTO90900
N90907{alarm7}(TOOLPOINT NOT G40 G80)
GOTO90900
N90908{alarm8}(TOOLPOINT MEMORY DAMAGED)
GOTO90900
N90909{alarm9}(TOOLPOINT OFFSET UNSETTLED)
@check
GOTO90900
N90910{alarm10}(TOOLPOINT CHECK DIFFERS)
@end
@placed
GOTO90900
N90912{alarm12}(TOOLPOINT OUTSIDE TRAVEL)
N90913(STATUS 13, CALL AGAIN)
@end
N90900M99
