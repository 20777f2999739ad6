O{program}(TOOLPOINT SAFE POINT BEGINS)
(G65P{program} WHEN THE TOOL IS CLEAR OF THE WORK)
{stop}
#{safe_flag}=1
G65P{guard}
M99
