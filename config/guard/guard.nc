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
N10
#1=#{sequence_b}
@axes
#{local}=#{value}(VALUE {letter})
@end
#3=#{valid_until}(VALID UNTIL)
#4=#{enable}(ENABLE BITS)
#2=#{sequence_a}
IF[#1EQ#2]GOTO20
#10=#10+1
IF[#10GT{tries}]GOTO20
G04P{retry_ms}
{stop}
GOTO10
N20
#6=#3001/1000(CLOCK, S)
(SETTLE WHAT A RESET INTERRUPTED)
IF[#4006NE21]GOTO300
IF[#{pending}EQ0]GOTO200
@axes
IF[#{pending}EQ{number}]GOTO{settle}
@end
GOTO290
@axes
N{settle}#21=#{planned}(DONE)
IF[ABS[#{offset}-#{after}]LT{half}]GOTO{settled}
#21=#{planned}-#{after}+#{before}(NOT DONE)
IF[ABS[#{offset}-#{before}]LT{half}]GOTO{settled}
#8=9
GOTO300
N{settled}#{echo}=#21{per_unit}
#{mirror}=#21
#{pending}=0
GOTO200
@end
(IS THE MEMORY WHOLE)
N200
@axes
IF[#{echo}EQ#0]GOTO290
IF[#{mirror}EQ#0]GOTO290
IF[ABS[#{echo}{to_mm}-#{mirror}]GT{half}]GOTO290
IF[ABS[#{mirror}]GT{bound_slack}]GOTO290
@end
GOTO300
N290#8=8
(JUDGE THE BLOCK)
N300
IF[#1EQ#0]GOTO310
IF[#2EQ#0]GOTO310
IF[#1EQ#2]GOTO320
N310#7=2(TORN. IF LEFT SO BY A DEAD WRITER IT EXPIRES TOO)
IF[#4EQ#0]GOTO800
IF[#4EQ0]GOTO800
IF[#3EQ0]GOTO800
IF[#3EQ#0]GOTO330
IF[#3GT#6+{look_ahead}]GOTO330
IF[#3GT#6]GOTO800
GOTO330
N320
IF[#4EQ#0]GOTO540
IF[#4EQ0]GOTO510
N330
IF[#4LT0]GOTO550
IF[#4GT{all_bits}]GOTO550
IF[FIX[#4]NE#4]GOTO550
IF[#4006NE21]GOTO560
IF[#4007NE40]GOTO570
IF[#4009NE80]GOTO570
IF[#8NE0]GOTO580
IF[#7EQ2]GOTO400
IF[#3EQ#0]GOTO400
IF[#3LE#6]GOTO400
IF[#3GT#6+{look_ahead}]GOTO400
@axes
IF[[FIX[#4/{bit}]AND1]EQ0]GOTO{judged}
IF[#{local}EQ#0]GOTO540
IF[ABS[#{local}{to_mm}]GT{bound_tolerance}]GOTO550
N{judged}
@end
GOTO600
(EXPIRED. A BLOCK THAT HAS EXPIRED ONCE NEVER COUNTS AGAIN)
N400#7=3
IF[#{valid_until}EQ#3]THEN#{valid_until}=#0
@keep
GOTO800(POLICY KEEP)
@end
@zero
(POLICY ZERO, STEP BY STEP)
@end
@zero_axes
#{local}=0
@end
(APPLY THE DIFFERENCE, AXIS BY AXIS, EACH WRITTEN AHEAD)
N600
@axes
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
IF[ABS[#{offset}-#{after}]GT{half}]GOTO590
#{echo}=#{planned}{per_unit}
#{mirror}=#{planned}
#{pending}=0
N{applied}
@end
GOTO800
N510#7=1
GOTO800
N540#7=4
GOTO800
N550#7=5
GOTO800
N560#7=6
GOTO800
N570#7=7
GOTO800
N580#7=#8
GOTO800
N590#7=9
(ECHO)
N800
#{echo_time}=#6
#{echo_status}=#7
#{echo_guard_version}={version}
G#5
IF[#7LT3]GOTO900
#9=#7+900
GOTO#9
N903{alarm3}(TOOLPOINT EXPIRED)
GOTO900
N904{alarm4}(TOOLPOINT VACANT MACRO)
GOTO900
N905{alarm5}(TOOLPOINT OVERSIZE VALUE)
GOTO900
N906{alarm6}(TOOLPOINT INCH MODE)
GOTO900
N907{alarm7}(TOOLPOINT NOT G40 G80)
GOTO900
N908{alarm8}(TOOLPOINT MEMORY DAMAGED)
GOTO900
N909{alarm9}(TOOLPOINT OFFSET UNSETTLED)
N900M99
