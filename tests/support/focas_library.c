/* Stands for FANUC's FOCAS2 library: its published signatures, and a control that holds macro variables itself.
 *
 * Built by the tests with the computer's compiler. Lines of the file FOCAS_FILE decide how it behaves: "refuse N"
 * refuses #N, "gone 0" loses the link, "crash 0" ends the process, "hang 0" never answers.
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#pragma pack(push, 4)
typedef struct { int16_t addinfo, max_axis; char cnc_type[2], mt_type[2], series[4], version[4], axes[2]; } ODBSYS;
typedef struct { int16_t hdck, tmmode, aut, run, motion, mstb, emergency, alarm, edit; } ODBST;
typedef struct { int16_t dummy[2]; int16_t data, mdata; } ODBPRO;
typedef struct { int16_t dummy[2]; int32_t data; } ODBSEQ;
typedef struct { int16_t dummy[2]; int32_t data; } ODBACT;
typedef struct { int16_t datano_s, dummy, datano_e; struct { int32_t mcr_val; int16_t dec_val; } data[5]; } IODBMR;
#pragma pack(pop)

static struct { int32_t value; int16_t decimals; } macros[10000];

static int told(const char *word, int number) {
    char found[32];
    int at, is = 0;
    FILE *file = fopen(FOCAS_FILE, "r");
    if (!file) return 0;
    while (fscanf(file, "%31s %d", found, &at) == 2)
        if (!strcmp(found, word) && at == number) is = 1;
    fclose(file);
    return is;
}

static int16_t link_state(void) {
    if (told("crash", 0)) abort();
    while (told("hang", 0)) sleep(1);
    return told("gone", 0) ? -16 : 0;
}

static void put(int number, int32_t value, int16_t decimals) {
    macros[number].value = value;
    macros[number].decimals = decimals;
}

int16_t cnc_startupprocess(int32_t level, const char *file) { return level == 0 && file ? 0 : 2; }

int16_t cnc_allclibhndl3(const char *host, unsigned short port, long timeout, unsigned short *handle) {
    if (strcmp(host, "127.0.0.1") || !port || timeout < 1 || told("gone", 0)) return -16;
    for (int number = 0; number < 10000; number++) put(number, 0, -1);
    put(4014, 54, 0);
    put(4120, 3, 0);
    *handle = 1;
    return 0;
}

int16_t cnc_freelibhndl(unsigned short handle) { return handle == 1 ? 0 : -8; }

int16_t cnc_sysinfo(unsigned short handle, ODBSYS *found) {
    memset(found, ' ', sizeof *found);
    memcpy(found->cnc_type, "0 ", 2);
    memcpy(found->series, "TEST", 4);
    return link_state();
}

int16_t cnc_statinfo(unsigned short handle, ODBST *found) {
    memset(found, 0, sizeof *found);
    found->aut = 1;
    found->run = 3;
    return link_state();
}

int16_t cnc_rdprgnum(unsigned short handle, ODBPRO *found) {
    found->data = 9010;
    found->mdata = 1000;
    return link_state();
}

int16_t cnc_rdseqnum(unsigned short handle, ODBSEQ *found) {
    found->data = 20;
    return link_state();
}

int16_t cnc_acts(unsigned short handle, ODBACT *found) {
    found->data = 5000;
    return link_state();
}

int16_t cnc_rdmacror(unsigned short handle, int16_t first, int16_t last, int16_t length, IODBMR *found) {
    struct timespec now;
    struct tm day;
    time_t on;
    if (length != 8 + 8 * (last - first + 1) || last - first > 4) return 2;
    clock_gettime(CLOCK_MONOTONIC, &now);
    put(3001, (int32_t)(now.tv_sec % 1000000) * 1000 + (int32_t)(now.tv_nsec / 1000000), 0);
    on = time(NULL);
    gmtime_r(&on, &day);
    put(3011, (day.tm_year + 1900) * 10000 + (day.tm_mon + 1) * 100 + day.tm_mday, 0);
    put(3012, day.tm_hour * 10000 + day.tm_min * 100 + day.tm_sec, 0);
    found->datano_s = first;
    found->datano_e = last;
    for (int number = first; number <= last; number++) {
        found->data[number - first].mcr_val = macros[number].value;
        found->data[number - first].dec_val = macros[number].decimals;
    }
    return link_state();
}

int16_t cnc_wrmacro(unsigned short handle, int16_t number, int16_t length, int32_t value, int16_t decimals) {
    if (length != 10) return 2;
    if (value > 999999999 || value < -999999999 || decimals < 0 || decimals > 9) return 5;
    if (told("refuse", number)) return 7;
    put(number, value, decimals);
    return link_state();
}
